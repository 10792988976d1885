"""Initialization Point Cloud Structural Deviation (paper, section III-D). NumPy and SciPy."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree


def ipsd(initial: np.ndarray, structural: np.ndarray) -> float:
    """IPSD = 1/N sum over initial points of the distance to the closest structural point.

    In the points' unit (the paper's numbers: the normalised frame, with a longest side of 2). NaN if either set
    is empty.

    Parameters
    ----------
    initial : ndarray
        P, [N, 3]: the points the fit started from.
    structural : ndarray
        T, [M, 3]: current centres of the Gaussians that densification made and did not remove.
    """
    if len(initial) == 0 or len(structural) == 0:
        return float('nan')
    return float(KDTree(structural).query(initial)[0].mean())


def reverse_distance(initial: np.ndarray, structural: np.ndarray) -> float:
    """The mean distance from the structural points to the closest initial point: IPSD with exchanged roles.

    IPSD alone is small if Gaussians split everywhere. This number shows how much structure the initial points
    missed.
    """
    return ipsd(structural, initial)
