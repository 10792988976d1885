"""Circular scans of either beam whose voxels have TIGRE's names, or are a grid."""

from typing import Any

from lingo_mi.geometry import CircularGeometry
from lingo_mi.geometry.grid import Voxels, grid_of


def circle(**numbers: Any) -> CircularGeometry:
    """The `CircularGeometry` of these numbers, with `grid`, or nVoxel, dVoxel and offOrigin."""
    voxels = {name: numbers.pop(name) for name in Voxels.__annotations__ if name in numbers}
    return CircularGeometry(grid=grid_of(voxels), **numbers)
