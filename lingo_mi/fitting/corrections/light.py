"""Scattered photons: estimated from the cloud at a few steps, and constant in between."""

from __future__ import annotations

import numpy as np

from lingo_mi.fitting.corrections.correction import CorrectedFit, Correction, due
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.models.scattered_light import light_at_pixels
from lingo_mi.projectors.upload import uploaded

# Shares of the iterations before which the light is estimated again. It depends only on the object's coarse shape, which a fit
# finds first.
WHEN = 0, 1 / 16, 1 / 8, 1 / 4, 1 / 2


class Light(Correction):
    """The light that the cloud scatters into the views; `scattered` is the output of `ScatteredLight.estimate`."""

    def __init__(self):
        self.scattered: np.ndarray | None = None

    def before_step(self, fit: CorrectedFit, state: DeviceState, iteration: int) -> None:
        if due(WHEN, iteration, fit.method.iterations):
            self.estimate(fit, state)

    def estimate(self, fit: CorrectedFit, state: DeviceState) -> None:
        """Estimate the light from the cloud as it is."""
        self.scattered = fit.model.scattered_light(state, fit.corrected())
        self._give(fit)

    def arrays(self) -> dict[str, np.ndarray]:
        return {} if self.scattered is None else dict(scattered=self.scattered)

    def restore(self, fit: CorrectedFit, arrays: dict[str, np.ndarray]) -> None:
        self.scattered = arrays.get('scattered')
        self._give(fit)

    def _give(self, fit: CorrectedFit) -> None:
        if self.scattered is not None:
            for target, image in zip(fit.targets, light_at_pixels(self.scattered, fit.model.geometry)):
                target.scattered = uploaded(image.ravel())
