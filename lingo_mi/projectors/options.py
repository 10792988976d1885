"""Options of line integrals: the cut-off, the model of a footprint, the rule for a pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.errors import InputError, shown
from lingo_mi.projectors import cutoff
from lingo_mi.projectors.balance import SHARING, Sharing
from lingo_mi.projectors.view import View

FOOTPRINTS = 'exact', 'affine'
MOST_SUBPIXELS = 16


@dataclass(frozen=True)
class RenderOptions:
    """The parameters of `lingo_xray`, and how its work is shared out.

    Parameters
    ----------
    extent : float
        Cut-off of Gaussians in standard deviations.
    footprint : str
        'exact', or 'affine': the ray's whitened length |d|^2 is constant, as at the Gaussian's centre (EWA).
    pixel : int
        N: a pixel is the mean of n x n rays, through the centres of its n x n parts.
    area : bool
        A pixel is the mean over its area instead of the ray through its centre, for Gaussians only: the footprint is convolved
        with a Gaussian of the pixel's variance.
    sharing : Sharing
        How the work on Gaussians is shared out (see `balance`).
    """

    extent: float = cutoff.RENDER
    footprint: str = 'exact'
    pixel: int = 1
    area: bool = False
    sharing: Sharing = SHARING

    @staticmethod
    def of(
        accuracy: Any = 'default', extent: Any = None, footprint: Any = 'exact', pixel: Any = 'centre'
    ) -> RenderOptions:
        """The options from plugin parameters. extent=None means the cut-off of the preset `accuracy`. Raises InputError."""
        if accuracy not in cutoff.PRESETS:
            raise InputError(f'lingo_xray: accuracy is one of {", ".join(cutoff.PRESETS)}, not {accuracy!r}')
        extent = cutoff.PRESETS[accuracy] if extent is None else extent
        if not (isinstance(extent, int | float) and 1 <= float(extent) <= 20):
            raise InputError(f'lingo_xray: extent is in standard deviations, from 1 to 20, not {shown(extent)}')
        if footprint not in FOOTPRINTS:
            raise InputError(f'lingo_xray: footprint is one of {", ".join(FOOTPRINTS)}, not {footprint!r}')
        return RenderOptions(extent, footprint, 1 if pixel == 'area' else _subpixels(pixel), pixel == 'area')

    def subdivided(self, view: View) -> View:
        """The view with every pixel divided into n x n parts."""
        n = self.pixel
        if n == 1:
            return view
        view.require_flat('a pixel of n x n rays')
        return replace(view, u=view.u / n, v=view.v / n, width=view.width * n, height=view.height * n)

    def averaged(self, image: Any, view: View) -> Any:
        """The image of `view` from an image of `subdivided(view)`: the mean over each pixel's parts."""
        n = self.pixel
        if n == 1:
            return image
        i, width = dr.arange(mi.UInt32, view.height * view.width), dr.opaque(mi.UInt32, view.width)
        first = (i // width * width * n + i % width) * n
        # Every ray is read once, so the derivative needs no atomics.
        parts = [
            dr.gather(mi.Float, image, first + y * width * n + x, mode=dr.ReduceMode.Permute)
            for y in range(n)
            for x in range(n)
        ]
        return sum(parts) / (n * n)


def _subpixels(pixel) -> int:
    """n of n x n rays, from 'centre', a number or its digits."""
    n = 1 if pixel == 'centre' else pixel
    try:
        n = float(n)
    except (TypeError, ValueError):
        n = math.nan
    if not (math.isfinite(n) and n == round(n) and 1 <= n <= MOST_SUBPIXELS):
        raise InputError(
            f"lingo_xray: pixel is 'centre', 'area' or n for n x n rays, from 1 to {MOST_SUBPIXELS}, not {pixel!r}"
        )
    return int(n)
