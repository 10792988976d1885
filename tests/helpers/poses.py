"""Helpers of tests of poses."""

import numpy as np

from lingo_mi.geometry.camera import camera_matrices


def to_matrices(rays):
    """Projection matrices, float64 [n, 3, 4], to whole numbers at pixel centres: the inverse of `from_matrices`."""
    return np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]) @ camera_matrices(rays)
