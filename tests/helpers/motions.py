"""Scans off the circle, for tests of projectors."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from helpers.grids import scan
from lingo_mi.geometry.base import Geometry


def posed(motion, mode='cone'):
    """The scan with its views moved: motion(rays, a random generator) returns what differs in the rays."""
    geo = scan(mode, n=3)
    rays = geo.rays()
    rays = replace(rays, **motion(rays, np.random.default_rng(5)))
    return Geometry.from_poses(rays, geo.nDetector, grid=geo.grid)


def climbing(rays, _):
    shift = [-6.0, 2.0, 9.0] * np.array([[0], [0], [1.0]])
    return dict(corner=rays.corner + shift.T) | ({} if rays.parallel else dict(source=rays.source + shift.T))


def shaken(rays, rng):
    shift = rng.normal(size=(2, 3, 3)) * [3.0, 3.0, 3.0]
    return dict(corner=rays.corner + shift[0]) | ({} if rays.parallel else dict(source=rays.source + shift[1]))


def turned(rays, _):
    """Panels by 0.3 radians about z."""
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1.0]])
    return dict(u=rays.u @ turn.T, corner=rays.corner + 21 / 2 * (rays.u - rays.u @ turn.T))


def reversed_panel(rays, _):
    """Rows from below, columns from the other side."""
    return dict(u=-rays.u, v=-rays.v, corner=rays.corner + 21 * rays.u + 17 * rays.v)


def tilted(*turn):
    """Source and panel turned about the origin by a rotation vector, radians."""

    def motion(rays, _):
        moved = rays.moved(Rotation.from_rotvec(turn).as_matrix())
        return dict(source=moved.source, corner=moved.corner, u=moved.u, v=moved.v)

    return motion


def rolled(rays, _):
    """Panels by 1.3 radians about their normal, through their corner moved by 20 pixels; each view by more."""
    turns = [
        Rotation.from_rotvec(a * np.cross(u, v) / np.linalg.norm(np.cross(u, v)))
        for a, u, v in zip((1.3, 1.5, 1.7), rays.u, rays.v)
    ]
    u, v = (np.stack([turn.apply(x) for turn, x in zip(turns, steps)]) for steps in (rays.u, rays.v))
    centre = rays.corner + 21 / 2 * rays.u + 17 / 2 * rays.v
    return dict(u=u, v=v, corner=centre - 21 / 2 * u - 17 / 2 * v)


def curved(motion=None, radius=None, **changes):
    """The scan with its panel bent, an arc of 60 degrees."""
    geo = scan(n=3, nDetector=(17, 41), dDetector=(3.0, 7.6), **changes)
    if motion:
        geo = Geometry.from_poses(replace(geo.rays(), **motion(geo.rays(), None)), geo.nDetector, grid=geo.grid)
    return geo.curved(radius)
