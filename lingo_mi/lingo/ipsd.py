"""Initialization Point Cloud Structural Deviation (paper, section III-D). NumPy and SciPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree


def ipsd(initial: np.ndarray, structural: np.ndarray) -> float:
    """IPSD = 1/N sum over initial points of the distance to the closest structural point.

    initial     P, [N, 3]: the points the fit started from
    structural  T, [M, 3]: current centres of the surviving Gaussians born by clone or split

    Same units as the points (the paper's numbers: the frame whose longest side is 2). NaN where either set is
    empty.
    """
    if len(initial) == 0 or len(structural) == 0:
        return float('nan')
    return float(KDTree(structural).query(initial)[0].mean())


def reverse_distance(initial: np.ndarray, structural: np.ndarray) -> float:
    """The mean distance from the structural points to the closest initial point: roles exchanged.

    IPSD alone rewards splitting everywhere; this number tells how much structure the initial points had
    missed.
    """
    return ipsd(structural, initial)


def neighbour_distance(points: ArrayLike, fallback: float) -> np.ndarray:
    """Root mean square distance to the three nearest neighbours, [N] (R2-Gaussian's initial scale).

    With fewer than four points the neighbours there are count; a lone point gets `fallback`.
    """
    points = np.asarray(points, float)
    k = min(4, len(points))
    if k < 2:
        return np.full(len(points), float(fallback))
    distance = KDTree(points).query(points, k, workers=-1)[0][:, 1:]
    return np.sqrt(np.mean(distance**2, 1))
