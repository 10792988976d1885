"""Scans that the studies simulate: one over a full turn, and the noise of photons."""

from __future__ import annotations

import numpy as np

from lingo_mi.effects.detector import Detector
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.phantoms.x3d_scan import default_geometry
from lingo_mi.projectors import grid
from lingo_mi.studies.tables.objects import averaged, load_object

LARGEST = 4.0  # line integral of a scan: 1.8 % of the photons arrive


def simulated(name: str, size: int, pixels: int, views: int, finer: int) -> tuple[Geometry, np.ndarray, np.ndarray]:
    """A cone-beam scan over a full turn of one of `studies.tables.objects`: geometry, line integrals [view, v, u] up to LARGEST,
    and true volume.

    size     voxels along the longest side
    pixels   along the sides of the panel, which is twice as wide as the object
    finer    how many times as many voxels are scanned along each side
    """
    thing = load_object(name, size * finer)
    truth = averaged(thing, size)
    geometry = default_geometry(thing, circular(views), pixels)
    line_integrals = grid.project_volume(thing.data, geometry)
    unit = np.float32(LARGEST / line_integrals.max())
    return geometry.on(truth.grid), line_integrals * unit, truth.data * unit


def counting(photons: float, electronic_noise: float = 0.0) -> Detector:
    """A detector that counts so many photons a pixel in the open beam; its electronics' noise is in photons.

    Raises InputError for values out of their ranges.
    """
    return Detector.of(**(Detector.DEFAULTS | dict(photons=photons, electronic_noise=electronic_noise)))


def noisy(views: np.ndarray, detector: Detector, seed: int = 0) -> np.ndarray:
    """Line integrals [view, v, u] as a detector reports them."""
    return np.stack([detector.measure(np.exp(-view.astype(float)), i, seed) for i, view in enumerate(views)])
