"""Models that render and voxelize the states of a fit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from lingo_mi.calibration.response.response import Response
from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors.objects import Ellipsoids

Gaussians = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Model(ABC):
    """Renders and voxelizes the states of a fit. It needs no scan.

    Attributes
    ----------
    geometry : Geometry
        Geometry of the scan, as given; defines the normalised frame and the default grid of `volume`.
    unit : float
        The density that the fit counts as 1, in 1/mm.
    effects : Effects or None
        Effects of the scan, if the fit models them; None: projections are line integrals.
    response : Response or None
        Response of the detector to line integrals, if it is fitted.
    """

    effects: Effects | None = None
    response: Response | None = None

    def __init__(self, geometry: Geometry, unit: float):
        self.geometry, self.unit = geometry, unit

    @abstractmethod
    def render(
        self, state: DeviceState, geometry: Geometry, progress: Callable[[int, int], None] | None = None
    ) -> np.ndarray:
        """Noise-free projections in the views of a geometry, float32 [view, v, u], as the scan's detector would see them.

        Parameters
        ----------
        progress : callable or None
            Called as progress(views done, all views).
        """

    def line_integrals(self, state: DeviceState, geometry: Geometry) -> np.ndarray:
        """Line integrals in the views of a geometry, float32 [view, v, u], density times mm, without any effects."""
        return self.render(state, geometry)

    def expected(self, state: DeviceState, geometry: Geometry) -> np.ndarray:
        """Return the signal that the scan's detector is expected to measure: `render` with the fitted response."""
        rendered = self.render(state, geometry)
        return rendered if self.response is None else self.response.applied(rendered, geometry)

    def volume(self, state: DeviceState, grid: Grid | None = None) -> np.ndarray:
        """The density at the voxel centres of a grid (default: the scan's), 1/mm, float32 [x, y, z]."""
        raise InputError(
            'this method fits opacities, not densities, and has no volume: reconstruct one from its views, with '
            'lm.reconstruct(scan, algorithm, start=fit, views=N)'
        )

    def gaussians(self, state: DeviceState) -> Gaussians:
        """Centres and standard deviations, mm; quaternions (x, y, z, w); densities, 1/mm, or opacities: float64 [N, ...]."""
        raise InputError('a neural field has no Gaussians: take its volume or its views')

    def cloud(self, state: DeviceState) -> Ellipsoids | None:
        """The Gaussians in mm, densities in 1/mm, as an object that effects are simulated with; None without densities."""
        return None

    def shares(self, state: DeviceState):
        """The second material's share in every Gaussian's density, Float [N]; None for one material."""
        return None
