"""Objects of a scene on a grid: their density at its voxels, and their bounding box."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import triangles
from lingo_mi.projectors import cutoff
from lingo_mi.projectors.objects import Ellipsoids, GridInCube, HomogeneousMesh, Instance
from lingo_mi.projectors.rotation import rows_of
from lingo_mi.projectors.view import vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize


def on_grid(
    obj: Any,
    corner: np.ndarray,
    step: Sequence[float] | np.ndarray,
    shape: tuple[int, int, int],
    extent: float = cutoff.SAMPLE,
) -> np.ndarray:
    """Density of one of a scene's objects (see `objects`) on a grid, float32 [x, y, z].

    Gaussians are sampled at the voxel centres. A mesh is weighted by the share of each voxel that it fills. A grid is
    interpolated trilinearly, and averaged over voxels larger than its own; on its own voxels it is returned unchanged.

    Parameters
    ----------
    corner, step
        [3] the outer corner of the first voxel, and the voxel size, mm.
    shape : tuple[int, int, int]
        Voxels along x, y and z.
    extent : float
        Cut-off of Gaussians in standard deviations.
    """
    nx, ny, nz = shape
    _refuse_instance(obj)
    if isinstance(obj, Ellipsoids):
        cells = Lattice(vector64(corner), vector64(step), (nx, ny, nz))
        return cells.volume(voxelize(obj.centre, obj.scale, obj.rotation, obj.density, cells, extent, deep=True))
    if isinstance(obj, HomogeneousMesh):
        sigma = np.ravel(obj.sigma)[0] * np.ravel(obj.scale)[0]
        return triangles.voxelize_triangles(obj.triangles(), corner, step, shape) * np.float32(sigma)
    values = grid_values(obj)
    low, high = _box(obj)
    voxel = (high - low) / values.shape
    if (
        values.shape == (nx, ny, nz)
        and np.allclose(low, corner, atol=1e-4 * voxel.min())
        and np.allclose(voxel, step, rtol=1e-4)
    ):
        return values
    # Voxel centres in the object's own voxels; those outside its box are empty.
    at = [((corner[k] + (np.arange(shape[k]) + 0.5) * step[k]) - low[k]) / voxel[k] - 0.5 for k in range(3)]
    inside = [(a >= -0.5) & (a <= n - 0.5) for a, n in zip(at, values.shape)]
    over = np.maximum(1, np.round(np.asarray(step) / voxel)).astype(int)
    if (over > 1).any():
        even = 1 - over % 2  # the mean over voxels i - n / 2 to i + n / 2 - 1, whose middle is i - 1 / 2, stands at i
        values = uniform_filter(np.pad(values, [(0, e) for e in even], mode='edge'), over.tolist(), mode='nearest')
        at = [a + e / 2 for a, e in zip(at, even)]
    samples = map_coordinates(values, np.meshgrid(*at, indexing='ij'), order=1, mode='nearest')
    return samples * (inside[0][:, None, None] & inside[1][:, None] & inside[2])


def grid_values(grid: GridInCube) -> np.ndarray:
    """Densities of a grid, float32 [x, y, z]."""
    return grid.data.numpy().reshape(grid.size[::-1]).transpose(2, 1, 0) * np.float32(np.ravel(grid.scale)[0])


def bounds(objects: Iterable) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner, float64 [3], of the objects' bounding box; Gaussians extend to 4 standard deviations."""
    boxes = [_box(obj) for obj in objects]
    return np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)


def _refuse_instance(obj):
    if isinstance(obj, Instance):
        raise InputError(
            f'the density of {obj.name!r} in a shapegroup is not sampled, which scattered light needs: put the shape into the '
            'scene itself, with the to_world of its instance'
        )


def _box(obj):
    _refuse_instance(obj)
    if isinstance(obj, GridInCube):
        return np.array(obj.low, float).ravel(), np.array(obj.high, float).ravel()
    if isinstance(obj, HomogeneousMesh):
        points = obj.triangles().reshape(-1, 3)
        return points.min(0), points.max(0)
    reach = mi.Vector3f(*(cutoff.BOX * dr.norm(obj.scale * row) for row in rows_of(obj.rotation, mi.Vector3f)))
    low, high = obj.centre - reach, obj.centre + reach
    return (
        np.array([float(dr.min(low[i])[0]) for i in range(3)]),
        np.array([float(dr.max(high[i])[0]) for i in range(3)]),
    )
