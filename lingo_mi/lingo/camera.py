"""The camera matrices M_o of the paper's section III-A. Pure NumPy."""
from __future__ import annotations

import numpy as np

from ..geometry import Frames


def camera_matrices(frames: Frames) -> np.ndarray:
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
