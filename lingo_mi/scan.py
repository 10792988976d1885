"""A scan: projections and their geometry. Pure NumPy."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import InputError
from .geometry import Geometry


@dataclass(frozen=True)
class Scan:
    """Measured or simulated projections.

    geometry      in mm
    projections   float32 [view, v, u]: line integrals ln(I0 / I), density times mm
    """

    geometry: Geometry
    projections: np.ndarray

    def __post_init__(self):
        p = np.asarray(self.projections, np.float32)
        expected = (len(self.geometry), *self.geometry.nDetector)
        if p.shape != expected:
            raise InputError(f'the projections have the shape {p.shape}, but the geometry says [view, v, u] = {expected}')
        if not np.isfinite(p).all():
            view = int(np.argwhere(~np.isfinite(p))[0, 0])
            raise InputError(f'the projections contain NaN or infinity (first in view {view}): '
                             'mask or repair those pixels first')
        object.__setattr__(self, 'projections', p)

    def __len__(self) -> int:
        return len(self.geometry)

    def subset(self, index) -> Scan:
        """The views `index` only."""
        return Scan(self.geometry.subset(index), self.projections[index])

    @property
    def normalised(self) -> np.ndarray:
        """Line integrals in the normalised frame, float32 [view, v, u]."""
        return self.projections * np.float32(self.geometry.scale)


@dataclass(frozen=True)
class Dataset:
    """What a file of a scan may hold: views to fit, views held out, and the true volume [x, y, z]."""

    train: Scan
    test: Scan | None = None
    volume: np.ndarray | None = None
