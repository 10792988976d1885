"""The interface of all corrections: what a fit learns of the measurement besides the cloud."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.view_loss import MeasuredView
from lingo_mi.geometry.base import Geometry


class CorrectedFit(Protocol):
    """State of the optimisation that a correction may read and change: the targets, and the share of the second material."""

    method: Any
    model: Any
    targets: list[MeasuredView]
    share: Any

    def corrected(self) -> Geometry: ...


class Correction:
    """A correction with its arrays, and the moments at which it acts. Every method does nothing by default.

    Attributes
    ----------
    moves_views : bool
        Whether the poses of the views change from step to step.
    """

    moves_views = False

    def before_step(self, fit: CorrectedFit, state: DeviceState, iteration: int) -> None:
        """Before a step, whose iteration counts from 0."""

    def before_view(self, fit: CorrectedFit, target: MeasuredView, view: int) -> None:
        """Before the image of a view is rendered."""

    def after_view(self, fit: CorrectedFit, target: MeasuredView, view: int, iteration: int) -> None:
        """After the loss of a view was differentiated."""

    def after_densification(self, fit: CorrectedFit) -> None:
        """After Gaussians were added, removed or put into another order."""

    def corrected(self, geometry: Geometry) -> Geometry:
        """The scan's geometry as corrected so far."""
        return geometry

    def between(self, scan: Geometry, geometry: Geometry) -> Geometry:
        """A geometry with corrections for the time of its views, which were taken during the scan."""
        return geometry

    def arrays(self) -> dict[str, np.ndarray]:
        """Its arrays by name, for a checkpoint."""
        return {}

    def restore(self, fit: CorrectedFit, arrays: dict[str, np.ndarray]) -> None:
        """Restore the output of `arrays`, and what depends on it."""


def due(shares: tuple[float, ...], iteration: int, iterations: int) -> bool:
    """Return whether an iteration is at one of these shares of a fit."""
    return iteration in {round(share * iterations) for share in shares}
