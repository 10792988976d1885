"""Helpers of tests of FDK."""

import numpy as np

from helpers.circles import circle
from lingo_mi.geometry.trajectories import circular
from lingo_mi.scan import Scan


def geometry(mode='cone', angles=None, **changes):
    settings = dict(
        DSO=300.0,
        DSD=450.0,
        nDetector=(64, 72),
        dDetector=(3.0, 3.0),
        nVoxel=(32, 36, 28),
        dVoxel=(4.0, 3.6, 4.4),
        mode=mode,
        angles=circular(360, start=3) if angles is None else angles,
        offOrigin=(5.0, -4.0, 3.0),
        offDetector=(4.0, -7.0),
    )
    return circle(**{**settings, **changes})


def ellipsoids(geo, *bodies):
    """Scan of ellipsoids (centre, semi-axes, density) by the closed form of the chord."""
    frames, out = geo.rays(curved=True), np.zeros((len(geo), *geo.nDetector))
    x, y = np.meshgrid(np.arange(geo.nDetector[1]) + 0.5, np.arange(geo.nDetector[0]) + 0.5)
    for view in range(len(geo)):
        o, d = frames.through(view, x, y)
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        for centre, axes, density in bodies:
            p, q = (o - centre) / axes, d / axes
            qq, pq = (q * q).sum(-1), (p * q).sum(-1)
            out[view] += 2 * density * np.sqrt(np.maximum(pq**2 - qq * ((p * p).sum(-1) - 1), 0)) / qq
    return Scan(geo, out)


def centres(geo):
    axes = [(np.arange(n) + 0.5 - n / 2) * d + o for n, d, o in zip(geo.grid.shape, geo.grid.spacing, geo.grid.centre)]
    return np.stack(np.meshgrid(*axes, indexing='ij'), -1)


BALL = (np.array([12.0, -9.0, 6.0]), np.array([25.0, 25.0, 25.0]), 0.02)


def ball_errors(volume, geo):
    """Return the errors of BALL: its mean density within half its radius, relative, and its place, in voxels of the worst
    axis."""
    x = centres(geo)
    near = np.linalg.norm(x - BALL[0], axis=-1)
    inside = near < 30  # farther out, the faint shading of what a cone misses weighs by its distance
    place = np.average(x[inside], axis=0, weights=volume[inside])
    return volume[near < 12].mean() / 0.02 - 1, np.max(np.abs(place - BALL[0]) / geo.grid.spacing)


def assert_ball(volume, geo):
    """BALL's density within 0.5 % around its centre, and its position within a tenth of a voxel."""
    density, place = ball_errors(volume, geo)
    assert abs(density) < 0.005 and place < 0.1
