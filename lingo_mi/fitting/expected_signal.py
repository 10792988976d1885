"""What a scan's detector is expected to see of a cloud: the effects of a scan inside the fit's forward model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.effects.forward import Effects
from lingo_mi.effects.hardening import hardened, second_share
from lingo_mi.fitting.scattered_light import ScatteredLight
from lingo_mi.geometry.base import Geometry
from lingo_mi.lingo.density import trilinear
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View


class ExpectedSignal:
    """The expected signal of a scan's detector, in the frame and the unit of a fit.

    A line integral q of the fit is p = factor q at the tube's reference energy, without a unit, and pixels are compared as
    -ln(I / I0) / factor. Two materials are told apart as in a grid, by the density at a Gaussian's centre (Joseph and
    Spital, J. Comput. Assist. Tomogr. 2, 1978, who divide a first reconstruction so); the shares are constants to the
    derivatives and are renewed now and then.

    effects     with lengths in the fit's frame
    bands       of the spectrum; None where no material matters
    split       densities between which the second material's share rises, 1/mm; None for one material
    scattered   the light that the cloud scatters; None where the scan is without
    """

    def __init__(self, effects: Effects, geometry: Geometry, unit: float):
        """effects: of the scan, in mm. unit: the density that counts as 1, 1/mm. Raises InputError for effects that a fit
        cannot reproduce."""
        self.effects = effects.scaled(geometry.scale)
        self.factor = dr.opaque(mi.Float, unit / geometry.scale)
        self.bands, self.split = None, None
        self.scattered = None
        if effects.tube and effects.scatter:
            self.scattered = ScatteredLight(effects.scatter, effects.tube, effects.response, geometry)
        if effects.tube and (effects.tube.hardens or effects.scatter):
            names = effects.tube.fitted()
            self.bands = effects.tube.signal(names, effects.response)
            self.split = effects.tube.split if len(names) == 2 else None

    def image(self, integrals: Callable[[View], Sequence], view: View, scattered: Any = None) -> Any:
        """What the pixels of a view are expected to be, Float [height * width]; differentiable.

        integrals   gives line integrals along the rays of a View, one Float a material
        scattered   light over the open beam's, Float [height * width], a constant to the derivatives; None: none
        """

        def seen(rays):
            parts = [self.factor * q for q in integrals(rays)]
            return hardened(parts, self.bands) if self.bands else parts[0]

        return self.effects.saturated(self.effects.averaged(seen, view, RenderOptions(), scattered), view) / self.factor

    def shares(self, volume: np.ndarray, centres: np.ndarray, half: np.ndarray) -> Any:
        """The second material's share in every Gaussian's density, Float [N]; None for one material.

        volume    [x, y, z], the cloud's density, 1/mm
        centres   [N, 3] and half, [3], half the volume's sides: both in the fit's frame
        """
        if self.split is None:
            return None
        return uploaded(second_share(trilinear(volume, centres, half).astype(float), self.split))
