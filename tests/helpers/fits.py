"""Helpers of tests of fits."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from helpers.circles import circle
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.start.start import Start, StartingCloud
from lingo_mi.geometry.trajectories import circular
from lingo_mi.phantoms.gaussians import Cloud
from lingo_mi.scan import Scan


def some_points(g, n=60, seed=1):
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3)) * np.minimum(g.grid.half, 1)
    if g.grid.shape[2] == 1:
        points[:, 2] = 0
    return StartingCloud(points, np.full(n, 0.1), np.full(n, 0.08))


@dataclass(frozen=True)
class Points(Start):
    """`some_points`, whatever the projections."""

    RANGES: ClassVar = dict(seed=(0, 1e9), n=(1, 1e6))
    name: ClassVar = 'points'

    seed: int = 1
    n: int = 60

    def cloud(self, scan, rng, render, unit):
        return some_points(scan.geometry, self.n, self.seed)


SHORT = R2(start=Points()).changed(
    normalise=True,
    iterations=30,
    densify_from=5,
    densify_until=100,
    densify_every=6,
    densify_threshold=8e-3,
    decay_steps=0,
    rate_centre=(4e-3, 4e-4),
    rate_density=(5e-2, 5e-3),
    rate_scale=(5e-2, 5e-3),
    rate_rotation=(2e-2, 2e-3),
    tv_size=8,
    max_gaussians=2000,
)


def geometry(views=3, **changes):
    settings = dict(
        DSO=500.0,
        DSD=750.0,
        nDetector=(32, 32),
        dDetector=(12.0, 12.0),
        nVoxel=(32, 32, 32),
        dVoxel=(8.0, 8.0, 8.0),
        angles=circular(views, 180, start=10),
    )
    return circle(**{**settings, **changes})


def tiny_scan(g, flat=False):
    """Eight Gaussians of 256 mm's proportions and their exact projections."""
    rng = np.random.default_rng(0)
    centres, scales = rng.uniform(-60, 60, (8, 3)), rng.uniform(8, 25, (8, 3))
    if flat:
        centres[:, 2] = 0
    turn = np.array([0, 0, 1, 1]) if flat else 1
    cloud = Cloud(centres, scales, rng.normal(size=(8, 4)) * turn, rng.uniform(0.2, 1, 8))
    cloud = replace(cloud, quaternions=cloud.quaternions / np.linalg.norm(cloud.quaternions, axis=1, keepdims=True))
    return Scan(g, cloud.project(g))


def error_of(fitted, scan):
    image = fitted.render(scan.geometry)
    return np.linalg.norm(image - scan.projections) / np.linalg.norm(scan.projections)


def assert_equal_states(a, b):
    assert len(a) == len(b)
    for group in ('values', 'first', 'second'):
        for k in a.values:
            np.testing.assert_array_equal(getattr(a, group)[k], getattr(b, group)[k])
    for name in ('gradient', 'visits', 'born'):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def stop_at(iteration):
    def progress(done, **_):
        if done == iteration:
            raise KeyboardInterrupt

    return progress
