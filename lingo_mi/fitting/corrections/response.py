"""The detector's response: air levels and gains of the views, fitted again at a few steps to what the cloud would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lingo_mi.calibration.response.response import Response
from lingo_mi.fitting.corrections.correction import CorrectedFit, Correction, due
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.measured import trusted
from lingo_mi.fitting.view_loss import targets_of
from lingo_mi.scan import Scan

WHEN = tuple(k / 10 for k in range(1, 10))  # shares of the iterations before which the response is fitted again


class ResponseCorrection(Correction):
    """Gives the targets the line integrals that the model's response leaves of the measured views.

    So a step is the same with a response and without.
    """

    def __init__(self, response: Response, scan: Scan, effects: str, weights: str):
        """response: the response of the model; effects and weights: the options of the method and its loss."""
        self.response, self.measured, self.weights = response, trusted(scan, effects), weights

    def before_step(self, fit: CorrectedFit, state: DeviceState, iteration: int) -> None:
        if due(WHEN, iteration, fit.method.iterations):
            self.fit(fit, state)

    def fit(self, fit: CorrectedFit, state: DeviceState) -> None:
        """Fit the response to what the cloud, as it is, would give."""
        expected = fit.model.render(state, fit.corrected())
        self.response.fit(expected, self.measured.projections, self.measured.valid)
        self._give(fit)

    def arrays(self) -> dict[str, np.ndarray]:
        return self.response.arrays()

    def restore(self, fit: CorrectedFit, arrays: dict[str, np.ndarray]) -> None:
        self.response.restore(arrays)
        self._give(fit)

    def _give(self, fit: CorrectedFit) -> None:
        undone = self.response.undone(self.measured.projections, self.measured.geometry)
        new = targets_of(replace(self.measured, projections=undone), fit.model.unit, self.weights)
        for target, other in zip(fit.targets, new):
            target.pixels, target.weights = other.pixels, other.weights
