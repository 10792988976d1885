"""Initial clouds of the alpha-compositing baselines: points that do not depend on the projections. NumPy."""

from __future__ import annotations

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.lingo.voxel_filter import voxel_centres
from lingo_mi.metrics.ipsd import neighbour_distance


def random_points(half: np.ndarray, flat: bool, n_points: int, rng: np.random.Generator) -> InitialCloud:
    """Points drawn uniformly from the volume (3DGS without given points draws them from a cube around the scene).

    half       half the volume's sides in the normalised frame, [3]
    flat       True for a fan beam: all points lie in the plane z = 0
    rng        numpy Generator
    """
    points = rng.uniform(-1, 1, (n_points, 3)) * half * (1, 1, 0 if flat else 1)
    return _cloud('random', points, np.min(half))


def cuboid(shape: tuple[int, int, int], half: np.ndarray, step: int) -> InitialCloud:
    """The centres of every `step`-th voxel along the three axes, from the first on (X-Gaussian).

    shape, half   voxels of the volume, and half its sides in the normalised frame, [3] each

    Raises InputError for more than four million points.
    """
    axes = [np.arange(0, n, step) for n in shape]
    count = np.prod([len(axis) for axis in axes])
    if count > 4e6:
        raise InputError(f'the cuboid has {count:,} points: take a larger cuboid_step than {step}')
    cells = np.ravel_multi_index(np.meshgrid(*axes, indexing='ij'), shape).ravel()
    return _cloud('cuboid', voxel_centres(tuple(shape), half, cells), np.min(half))


def _cloud(method, points, fallback):
    return InitialCloud(points, None, neighbour_distance(points, fallback), {'method': method})
