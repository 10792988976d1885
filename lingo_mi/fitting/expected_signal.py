"""The signal that a scan's detector is expected to measure of a cloud: a scan's effects in the fit's forward model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.interpolation import trilinear
from lingo_mi.effects.forward import Effects
from lingo_mi.effects.hardening import hardened, second_share
from lingo_mi.fitting.models.scattered_light import ScatteredLight
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View


class ExpectedSignal:
    """The expected signal of a scan's detector, in the frame and the unit of a fit.

    A line integral q of the fit is p = factor q at the tube's reference energy, without a unit. Pixels are compared as
    -ln(I / I0) / factor. The density at a Gaussian's centre separates two materials, as in a grid (Joseph and Spital, J.
    Comput. Assist. Tomogr. 2, 1978, separate a first reconstruction in this way). The shares are constants for the
    derivatives and are updated every few steps.

    Attributes
    ----------
    effects
        With lengths in the fit's frame.
    bands
        Bands of the spectrum; None if materials do not matter.
    split
        Densities between which the second material's share rises, 1/mm; None for one material.
    scattered
        The light that the cloud scatters; None for a scan without scatter.
    """

    def __init__(self, effects: Effects, geometry: Geometry, unit: float):
        """effects: of the scan, in mm. unit: the fit's unit of density, 1/mm. Raises InputError for effects that a fit
        cannot model."""
        self.effects = effects.scaled(geometry.grid.scale)
        self.factor = dr.opaque(mi.Float, unit / geometry.grid.scale)
        self.bands, self.split = None, None
        self.scattered = None
        if effects.tube and effects.scatter:
            self.scattered = ScatteredLight(effects.scatter, effects.tube, effects.response, geometry)
        if effects.tube and effects.needs_materials:
            names = effects.tube.fitted()
            self.bands = effects.tube.signal(names, effects.response)
            self.split = effects.tube.split if len(names) == 2 else None

    def image(self, integrals: Callable[[View], Sequence], view: View, scattered: Any = None) -> Any:
        """The expected pixels of a view, Float [height * width]. Differentiable.

        Parameters
        ----------
        integrals : callable
            Function of a View that returns line integrals along its rays, one Float per material.
        scattered
            Scattered light relative to the open beam's, Float [height * width], not differentiated; None: none.
        """

        def seen(rays):
            parts = [self.factor * q for q in integrals(rays)]
            return hardened(parts, self.bands) if self.bands else parts[0]

        return self.effects.saturated(self.effects.averaged(seen, view, RenderOptions(), scattered), view) / self.factor

    def shares(self, volume: np.ndarray, centres: np.ndarray, half: np.ndarray) -> Any:
        """The second material's share in every Gaussian's density, Float [N]; None for one material.

        Parameters
        ----------
        volume : ndarray [x, y, z]
            The cloud's density, 1/mm.
        centres : ndarray
            [N, 3] and half, [3], half the volume's sides: both in the fit's frame.
        """
        if self.split is None:
            return None
        return uploaded(second_share(trilinear(volume, centres, half).astype(float), self.split))
