"""The true density of objects on the voxels of a scanner's grid, the reference for volumes."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.objects import Ellipsoids, GridInCube, Instance
from lingo_mi.projectors.sampling import on_grid


def true_volume(objects: Iterable, grid: Grid) -> np.ndarray | None:
    """The true density on the scanner's grid [x, y, z]; None if an object cannot be sampled on it."""
    total = np.zeros(grid.shape, np.float32)
    for obj in objects:
        if isinstance(obj, ScannedVolume):
            total += obj.data
        elif isinstance(obj, Instance):
            return None
        elif not isinstance(obj, GridInCube) or fills_grid(obj, grid):
            total += on_grid(obj, grid.low, grid.spacing, grid.shape)
        else:
            return None
    return total


def fills_grid(obj: GridInCube, grid: Grid) -> bool:
    """Return whether an object's grid is the scanner's grid."""
    near = 1e-4 * max(grid.size) / 2
    return (
        tuple(obj.size) == grid.shape
        and np.allclose(obj.low, grid.low, atol=near)
        and np.allclose(obj.high, grid.high, atol=near)
    )


class ScannedVolume:
    """A volume on the scan's own grid, as an object to scan."""

    def __init__(self, data: np.ndarray, grid: Grid):
        self.data, self.grid = data, grid

    def project(self, geometry: Geometry, progress: Callable[[int, int], None] | None) -> np.ndarray:
        return project_volume(self.data, geometry, progress)

    def in_box(self) -> GridInCube:
        """The volume as an object of a scene."""
        return GridInCube.of(self.data, self.grid.low, self.grid.high, 'volume')


def voxelize_cloud(cloud: Ellipsoids, grid: Grid, extent: float) -> np.ndarray:
    """Density of a cloud of Gaussians at the voxel centres of a grid, float32 [x, y, z], per mm.

    Parameters
    ----------
    extent : float
        Cut-off in standard deviations.
    """
    return on_grid(cloud, grid.low, grid.spacing, grid.shape, extent)
