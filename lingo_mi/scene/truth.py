"""The true density of objects on the voxels of a scanner's grid, the reference for volumes."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors import grid
from lingo_mi.projectors.objects import Ellipsoids, GridInCube
from lingo_mi.projectors.sampling import on_grid


def true_volume(objects: Iterable, geometry: Geometry) -> np.ndarray | None:
    """The true density on the scanner's grid [x, y, z]; None if an object cannot be sampled on it."""
    total = np.zeros(geometry.nVoxel, np.float32)
    corner = np.array(geometry.offOrigin) - np.array(geometry.sVoxel) / 2
    for thing in objects:
        if isinstance(thing, ScannedVolume):
            total += thing.data
        elif not isinstance(thing, GridInCube) or fills_grid(thing, geometry):
            total += on_grid(thing, corner, geometry.dVoxel, geometry.nVoxel)
        else:
            return None
    return total


def fills_grid(thing: GridInCube, geometry: Geometry) -> bool:
    """Whether an object's grid is the scanner's own."""
    centre, half = np.array(geometry.offOrigin), np.array(geometry.sVoxel) / 2
    return (
        tuple(thing.size) == geometry.nVoxel
        and np.allclose(thing.low, centre - half, atol=1e-4 * half.max())
        and np.allclose(thing.high, centre + half, atol=1e-4 * half.max())
    )


class ScannedVolume:
    """A volume on the scan's own grid, as an object to scan."""

    def __init__(self, data: np.ndarray, geometry: Geometry):
        self.data, self.box = data, geometry

    def project(self, geometry: Geometry, progress: Callable[[int, int], None] | None) -> np.ndarray:
        return grid.project(self.data, geometry, progress)

    def in_box(self) -> GridInCube:
        """The volume as an object of a scene."""
        centre, half = np.array(self.box.offOrigin), np.array(self.box.sVoxel) / 2
        return GridInCube.of(self.data, centre - half, centre + half, 'volume')


def voxelize_cloud(cloud: Ellipsoids, geometry: Geometry, extent: float) -> np.ndarray:
    """Density of a cloud of Gaussians at the voxel centres of the scan's grid, float32 [x, y, z], per mm.

    extent   cut-off in standard deviations
    """
    corner = np.array(geometry.offOrigin) - np.array(geometry.sVoxel) / 2
    return on_grid(cloud, corner, geometry.dVoxel, geometry.nVoxel, extent)
