"""Distances of points from their neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree


def neighbour_distance(points: ArrayLike, fallback: float) -> np.ndarray:
    """Root mean square distance to the three nearest neighbours, [N] (R2-Gaussian's starting scale).

    With fewer than four points, all others are neighbours. A single point gets `fallback`.
    """
    points = np.asarray(points, float)
    k = min(4, len(points))
    if k < 2:
        return np.full(len(points), float(fallback))
    distance = KDTree(points).query(points, k, workers=-1)[0][:, 1:]
    return np.sqrt(np.mean(distance**2, 1))
