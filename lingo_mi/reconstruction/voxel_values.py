"""The meaning of a voxel's number: the mean over its cube, or the value at its centre (NumPy and SciPy).

A projector reads numbers as values at the centres, between which it interpolates linearly. The mean of that function over a
voxel's cube is a weighted mean B of the value and its neighbours', 1/8, 3/4, 1/8 along each axis. Means over smaller voxels, read
as values, are therefore projected too smooth: by B once more.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

CUBE = 1 / 8, 3 / 4, 1 / 8
# Of Van Cittert's iteration. The inverse of B predicts views no better, and makes noise up to 8 times as large.
STEPS = 2


def means(volume: np.ndarray, finer: int) -> np.ndarray:
    """The means over `finer` voxels along each side."""
    return volume.reshape([n for count in volume.shape for n in (count // finer, finer)]).mean((1, 3, 5))


def values(mean: np.ndarray) -> np.ndarray:
    """The values at the centres of voxels [x, y, z] whose linear interpolation has about these means over the cubes.

    By Van Cittert's iteration v <- v + mean - B v (Z. Phys. 69, 1931). Beside edges they may be negative.
    """
    centres = mean
    for _ in range(STEPS):
        centres = centres + mean - cube_means(centres)
    return centres.astype(np.float32)


def cube_means(value: np.ndarray) -> np.ndarray:
    """B: the means over the cubes of voxels of the linear interpolation of values at their centres; constant outside."""
    for axis in range(3):
        value = ndimage.convolve1d(value, CUBE, axis, mode='nearest')
    return value
