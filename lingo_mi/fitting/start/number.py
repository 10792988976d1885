"""Starts whose number of Gaussians is an option."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from typing_extensions import Self

from lingo_mi.fitting.start.start import Start
from lingo_mi.geometry.base import Geometry


@dataclass(frozen=True)
class NumberedStart(Start):
    """A start of `n_points` Gaussians (paper, implementation details, and R2-Gaussian: 50,000)."""

    RANGES: ClassVar = dict(n_points=(1, 1e8))

    n_points: int = 50_000

    def count(self, geometry: Geometry) -> int:
        return self.n_points

    def limited(self, most: int) -> Self:
        return replace(self, n_points=min(self.n_points, most))
