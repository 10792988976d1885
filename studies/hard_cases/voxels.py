"""Clouds on voxels at the limits of float32."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from lingo_mi.validation.oracle import Cloud, random_cloud
from studies.hard_cases.clouds import turned
from studies.hard_cases.kinds import VoxelCase


def on_voxels() -> Iterator[VoxelCase]:
    """All of them."""
    rng = np.random.default_rng(8)
    for kind, scale in dict(needles=(0.3, 3e-5, 3e-5), pancakes=(0.3, 0.3, 3e-5)).items():
        rotation, step, shape = turned(rng, 20), np.full(3, 4e-5), (12, 11, 10)
        corner, n = np.array([0.2, -0.1, 0.05]), len(rotation)
        off = Rotation.from_quat(rotation).apply(rng.uniform(-1.5, 1.5, (n, 3)) * scale)
        centre = corner + rng.uniform(0, 1, (n, 3)) * step * shape + off
        cloud = Cloud(centre, np.tile(scale, (n, 1)), rotation, rng.uniform(0.2, 1, n))
        yield VoxelCase(f'voxels: {kind} 1:1e4', cloud, corner, step, shape)
    step, corner, shape, n = np.full(3, 0.1), np.full(3, -0.6), (12, 12, 12), 16
    for power in (-6, -4, -2, -1):
        size = 0.1 * 10.0**power
        centre = corner + (rng.integers(1, 11, (n, 3)) + 0.5) * step
        # Where float32 can name places so close to a voxel's centre: around the origin.
        corner_of = corner - 0.05 if power < -2 else corner
        centre = centre * (power >= -2) + size * rng.normal(size=(n, 3))
        cloud = Cloud(centre, size * rng.uniform(0.7, 1.4, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.2, 1, n))
        yield VoxelCase(f'voxels: scale 1e{power} voxels', cloud, corner_of, step, shape)
    yield VoxelCase('voxels: scale of 10 scenes', random_cloud(rng, 4, size=20.0), corner, step, shape)
    yield VoxelCase('voxels: density 1e6', random_cloud(rng, 6).changed(density=np.full(6, 1e6)), corner, step, shape)
    far = random_cloud(rng, 10)
    far = far.changed(centre=far.centre + 2e4)
    yield VoxelCase('voxels: world offset of 1e4 scenes', far, corner + 2e4, step, shape)
