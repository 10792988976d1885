"""The camera matrices M_o of the paper's section III-A. Pure NumPy."""

from __future__ import annotations

import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.rays import Rays


def camera_matrices(frames: Rays) -> np.ndarray:
    """Matrices [view, 3, 4] that take (x, y, z, 1) to (a w, b w, w), (a, b) = `frames.project`, float64.

    w grows linearly with the distance from the source along the panel's normal: 0 at the source, 1 on the
    panel, negative behind the source. A parallel beam has w = 1 everywhere.
    """

    def dot(p, q):
        return np.sum(p * q, 1, keepdims=True)

    normal = np.cross(frames.u, frames.v)
    duals = np.stack([np.cross(frames.v, normal), np.cross(normal, frames.u)], 1)
    duals /= dot(normal, normal)[:, None]
    out = np.zeros((len(frames), 3, 4))
    for row in range(2):
        dual = duals[:, row]
        if frames.parallel:
            slope = dual - dot(dual, frames.source) / dot(normal, frames.source) * normal
            out[:, row] = np.concatenate([slope, -dot(slope, frames.corner)], 1)
        else:
            to_panel = frames.corner - frames.source
            slope = dual - dot(dual, to_panel) / dot(normal, to_panel) * normal
            out[:, row] = np.concatenate([slope, -dot(slope, frames.source)], 1)
    if frames.parallel:
        out[:, 2, 3] = 1
    else:
        out[:, 2] = np.concatenate([normal, -dot(normal, frames.source)], 1) / dot(normal, to_panel)
    return out


def voxel_matrices(geometry: Geometry) -> np.ndarray:
    """Projection matrices [view, 3, 4] from voxel indices (i, j, k, 1) to (x w, y w, w), float64.

    x, y are continuous pixel positions as in `Rays`; w is the distance from the source along the panel's
    normal over its value at the axis (parallel: 1).
    """
    out = camera_matrices(geometry.rays())
    if geometry.mode == 'cone':
        out *= geometry.DSD / geometry.DSO  # w = 1 on the axis instead of the panel
    first = np.array(geometry.offOrigin) + (np.array(geometry.dVoxel) - geometry.sVoxel) / 2
    out[:, :, 3] += out[:, :, :3] @ first
    out[:, :, :3] *= geometry.dVoxel
    return out
