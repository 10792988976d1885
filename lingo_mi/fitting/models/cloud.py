"""The model of Gaussians: renders a state, through any forward model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.expected_signal import ExpectedSignal
from lingo_mi.fitting.models.forward import ForwardModel
from lingo_mi.fitting.models.model import Gaussians, Model
from lingo_mi.fitting.state import activate
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.view import View


class CloudModel(Model):
    """Renders Gaussians by a forward model: line integrals, or grey images composited from opacities.

    Attributes
    ----------
    signal : ExpectedSignal or None
        `ExpectedSignal` of the effects that the fit models; None without effects.
    """

    signal: ExpectedSignal | None = None

    def __init__(self, forward: ForwardModel, geometry: Geometry, unit: float):
        super().__init__(geometry, unit)
        self.forward = forward

    def render(
        self, state: DeviceState, geometry: Geometry, progress: Callable[[int, int], None] | None = None
    ) -> np.ndarray:
        return self._images(state, geometry, lambda along, view, i: along(view)[0], None, progress)

    def gaussians(self, state: DeviceState) -> Gaussians:
        centre, scale, rotation, amount = activate(state.host(), self.forward)
        size = self.geometry.grid.scale
        return centre / size + self.geometry.grid.centre, scale / size, rotation, amount * self.amount_unit

    @property
    def amount_unit(self) -> float:
        """The amount that the fit counts as 1; for opacities it is 1 itself."""
        return 1.0

    def _images(
        self,
        state: DeviceState,
        geometry: Geometry,
        image: Callable[[Callable, View, int], Any],
        share: Any,
        progress: Callable[[int, int], None] | None = None,
    ) -> np.ndarray:
        """The images of all views, float32 [view, v, u], density times mm.

        Parameters
        ----------
        image : callable
            Called with a function that renders along the rays of a view, the view, and its number.
        share
            Share of the second material in every Gaussian, or None.
        """
        g, (height, width) = self.geometry, geometry.nDetector
        # In the frame of the fit's own volume, whatever the voxels of this geometry.
        every = geometry.on(g.grid).normalised_rays(curved=True)
        gaussians = self.forward.gaussians(state.values)

        def along(rays):
            return self.forward.integrals(self.forward.footprints(gaussians, rays), rays, share)

        out = np.empty((len(geometry), height, width), np.float32)
        for i in range(len(geometry)):
            out[i] = image(along, View.of(every, i, height, width), i).numpy().reshape(height, width)
            if progress:
                progress(i + 1, len(geometry))
        out *= np.float32(self.unit / g.grid.scale)
        return out
