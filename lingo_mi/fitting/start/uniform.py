"""Starts that do not depend on the projections, for Gaussians with opacities. NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.start.number import NumberedStart
from lingo_mi.fitting.start.start import Render, Start, StartingCloud
from lingo_mi.lingo.voxel_filter import voxel_centres
from lingo_mi.scan import Scan

MOST_POINTS = 4e6  # of a cuboid


@dataclass(frozen=True)
class RandomStart(NumberedStart):
    """Points drawn uniformly from the volume. 3DGS without a point cloud draws 100,000 from a cube around the scene.

    In a fan beam, all points lie in the plane z = 0.

    Parameters
    ----------
    n_points : int
        Points of the cloud.

    Examples
    --------
    `lm.GaussianSplatting(start=lm.RandomStart())`
    """

    name: ClassVar = 'random'
    densities: ClassVar = False

    n_points: int = 100_000

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        half, flat = scan.geometry.grid.half, scan.geometry.grid.shape[2] == 1
        return _cloud(self.name, rng.uniform(-1, 1, (self.n_points, 3)) * half * (1, 1, 0 if flat else 1), half)


@dataclass(frozen=True)
class CuboidStart(Start):
    """The centres of every few voxels along the three axes, from the first on (X-Gaussian).

    Parameters
    ----------
    cuboid_step : int
        Voxels between points (X-Gaussian: 8). More than four million points are refused.

    Examples
    --------
    `lm.XGaussian(start=lm.CuboidStart(cuboid_step=4))`
    """

    RANGES: ClassVar = dict(cuboid_step=(1, 1e6))
    name: ClassVar = 'cuboid'
    densities: ClassVar = False

    cuboid_step: int = 8

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        shape, half, step = scan.geometry.grid.shape, scan.geometry.grid.half, self.cuboid_step
        axes = [np.arange(0, n, step) for n in shape]
        count = np.prod([len(axis) for axis in axes])
        if count > MOST_POINTS:
            raise InputError(f'the cuboid has {count:,} points: take a larger cuboid_step than {step}')
        cells = np.ravel_multi_index(np.meshgrid(*axes, indexing='ij'), shape).ravel()
        return _cloud(self.name, voxel_centres(tuple(shape), half, cells), half)


def _cloud(method: str, points: np.ndarray, half: np.ndarray) -> StartingCloud:
    return StartingCloud(points, None, neighbour_distance(points, np.min(half)), {'method': method})
