"""The mean pixel of a point, from which its density starts (paper, section III-B). NumPy."""

from __future__ import annotations

import numpy as np

from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.rays import Rays
from lingo_mi.lingo.voxel_filter import pixels


def mean_pixel(rays: Rays, projections: np.ndarray, points: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """C = 1/n sum over views of I_o[P^I_o], [N], in units of the projections.

    The mean is over the views in which the point projects to a valid pixel (in the paper's intersection, all
    views). A point outside all views has the mean 0.

    Parameters
    ----------
    rays : Rays
        n views in the normalised frame.
    projections : ndarray [n, v, u]
    points : ndarray [N, 3]
    valid : ndarray or None
        Bool [n, v, u], None: all pixels are valid.
    """
    points = np.ascontiguousarray(np.asarray(points, float).T)
    total, seen = np.zeros(points.shape[1]), np.zeros(points.shape[1])
    for view, (matrix, image) in enumerate(zip(camera_matrices(rays), projections)):
        index, inside = pixels(matrix, points, image.shape)
        if valid is not None:
            inside &= valid[view].reshape(-1)[index]
        total += np.where(inside, image.reshape(-1)[index], 0)
        seen += inside
    return total / np.maximum(seen, 1)
