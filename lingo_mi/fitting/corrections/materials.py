"""Two materials: the share of the second one in every Gaussian, estimated again every few steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi.fitting.corrections.correction import CorrectedFit, Correction
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.projectors.upload import uploaded

EVERY = 50  # steps between two estimates


class Materials(Correction):
    """The share of the second of two materials, by the density at every Gaussian's centre."""

    def __init__(self):
        self.share: Any = None

    def before_step(self, fit: CorrectedFit, state: DeviceState, iteration: int) -> None:
        if self.share is None or iteration % EVERY == 0:
            self.share = fit.model.shares(state)
        fit.share = self.share

    def after_densification(self, fit: CorrectedFit) -> None:
        self.share = None

    def arrays(self) -> dict[str, np.ndarray]:
        return {} if self.share is None else dict(share=self.share.numpy())

    def restore(self, fit: CorrectedFit, arrays: dict[str, np.ndarray]) -> None:
        if 'share' in arrays:
            self.share = uploaded(arrays['share'])
