"""Values of a volume between its voxel centres. NumPy and SciPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage


def trilinear(volume: np.ndarray, points: np.ndarray, half: ArrayLike) -> np.ndarray:
    """Trilinear interpolation of a volume at points, [N]; constant beyond the outermost voxel centres.

    Parameters
    ----------
    volume : ndarray [x, y, z]
    points : ndarray
        [N, 3] and half, [3], half the volume's sides: both in the normalised frame.
    """
    place = (np.asarray(points, float) / half + 1) / 2 * volume.shape - 0.5
    return ndimage.map_coordinates(volume, place.T, order=1, mode='nearest')
