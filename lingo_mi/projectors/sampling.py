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
    thing: Any,
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
    _require_own_place(thing)
    if isinstance(thing, Ellipsoids):
        cells = Lattice(vector64(corner), vector64(step), (nx, ny, nz))
        return cells.volume(
            voxelize(thing.centre, thing.scale, thing.rotation, thing.density, cells, extent, deep=True)
        )
    if isinstance(thing, HomogeneousMesh):
        sigma = np.ravel(thing.sigma)[0] * np.ravel(thing.scale)[0]
        return triangles.voxelize_triangles(thing.triangles(), corner, step, shape) * np.float32(sigma)
    values = grid_values(thing)
    low, high = _box(thing)
    own = (high - low) / values.shape
    if (
        values.shape == (nx, ny, nz)
        and np.allclose(low, corner, atol=1e-4 * own.min())
        and np.allclose(own, step, rtol=1e-4)
    ):
        return values
    # Voxel centres in the object's own voxels; those outside its box are empty.
    at = [((corner[k] + (np.arange(shape[k]) + 0.5) * step[k]) - low[k]) / own[k] - 0.5 for k in range(3)]
    inside = [(a >= -0.5) & (a <= n - 0.5) for a, n in zip(at, values.shape)]
    over = np.maximum(1, np.round(np.asarray(step) / own)).astype(int)
    if (over > 1).any():
        even = 1 - over % 2  # the mean over voxels i - n / 2 to i + n / 2 - 1, whose middle is i - 1 / 2, stands at i
        values = uniform_filter(np.pad(values, [(0, e) for e in even], mode='edge'), over.tolist(), mode='nearest')
        at = [a + e / 2 for a, e in zip(at, even)]
    found = map_coordinates(values, np.meshgrid(*at, indexing='ij'), order=1, mode='nearest')
    return found * (inside[0][:, None, None] & inside[1][:, None] & inside[2])


def grid_values(thing: GridInCube) -> np.ndarray:
    """Densities of a grid, float32 [x, y, z]."""
    return thing.data.numpy().reshape(thing.size[::-1]).transpose(2, 1, 0) * np.float32(np.ravel(thing.scale)[0])


def bounds(objects: Iterable) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner, float64 [3], of the objects' bounding box; Gaussians extend to 4 standard deviations."""
    boxes = [_box(thing) for thing in objects]
    return np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)


def _require_own_place(thing):
    if isinstance(thing, Instance):
        raise InputError(
            f'the density of {thing.name!r} in a shapegroup is not sampled, which scattered light needs: put the shape into the '
            'scene itself, with the to_world of its instance'
        )


def _box(thing):
    _require_own_place(thing)
    if isinstance(thing, GridInCube):
        return np.array(thing.low, float).ravel(), np.array(thing.high, float).ravel()
    if isinstance(thing, HomogeneousMesh):
        points = thing.triangles().reshape(-1, 3)
        return points.min(0), points.max(0)
    reach = mi.Vector3f(*(cutoff.BOX * dr.norm(thing.scale * row) for row in rows_of(thing.rotation, mi.Vector3f)))
    low, high = thing.centre - reach, thing.centre + reach
    return (
        np.array([float(dr.min(low[i])[0]) for i in range(3)]),
        np.array([float(dr.max(high[i])[0]) for i in range(3)]),
    )
