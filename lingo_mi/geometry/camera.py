"""The camera matrices M_o of the paper's section III-A. Pure NumPy."""

from __future__ import annotations

import numpy as np

from lingo_mi.geometry.rays import Rays


def camera_matrices(rays: Rays) -> np.ndarray:
    """Matrices [view, 3, 4] that take (x, y, z, 1) to (a w, b w, w), (a, b) = `rays.project`, float64.

    w grows linearly with the distance from the source along the panel's normal: 0 at the source, 1 on the
    panel, negative behind the source. A parallel beam has w = 1 everywhere.
    """

    def dot(p, q):
        return np.sum(p * q, 1, keepdims=True)

    normal = np.cross(rays.u, rays.v)
    duals = np.stack([np.cross(rays.v, normal), np.cross(normal, rays.u)], 1)
    duals /= dot(normal, normal)[:, None]
    out = np.zeros((len(rays), 3, 4))
    for row in range(2):
        dual = duals[:, row]
        if rays.parallel:
            slope = dual - dot(dual, rays.source) / dot(normal, rays.source) * normal
            out[:, row] = np.concatenate([slope, -dot(slope, rays.corner)], 1)
        else:
            to_panel = rays.corner - rays.source
            slope = dual - dot(dual, to_panel) / dot(normal, to_panel) * normal
            out[:, row] = np.concatenate([slope, -dot(slope, rays.source)], 1)
    if rays.parallel:
        out[:, 2, 3] = 1
    else:
        out[:, 2] = np.concatenate([normal, -dot(normal, rays.source)], 1) / dot(normal, to_panel)
    return out
