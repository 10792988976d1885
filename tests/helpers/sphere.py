"""A scan of a ball, by its chords."""

import numpy as np

from helpers.circles import circle
from lingo_mi.geometry.trajectories import circular


def sphere_scan(radius=0.5, n=6, centre=(0.2, -0.1, 0.15), density=0.8, **changes):
    """A ball in the normalised frame: geometry, frames, projections (chord times density)."""
    settings = dict(
        DSO=5.0,
        DSD=7.0,
        nDetector=(64, 64),
        dDetector=(0.055, 0.055),
        nVoxel=(48, 48, 48),
        dVoxel=(2 / 48,) * 3,
        angles=circular(n, start=5),
    )
    geometry = circle(**{**settings, **changes})
    frames, out = geometry.normalised_rays(), []
    x, y = np.meshgrid(np.arange(geometry.nDetector[1]) + 0.5, np.arange(geometry.nDetector[0]) + 0.5)
    for view in range(n):
        o, d = frames.through(view, x, y)
        away = np.cross(np.asarray(centre) - o, d / np.linalg.norm(d, axis=-1, keepdims=True))
        out.append(2 * density * np.sqrt(np.maximum(radius**2 - (away**2).sum(-1), 0)))
    return geometry, frames, np.array(out, np.float32)
