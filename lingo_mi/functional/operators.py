r"""The exact forward operators of a cloud of Gaussians, on whatever arrays the caller has.

    sigma(x) = sum_i density_i exp(-1/2 |diag(1/scale_i) R_i^T (x - mean_i)|^2)

`project` integrates sigma along the rays of a scan, in closed form (`projectors.footprint`); `voxelize` samples it at the
centres of voxels. The result is an array of the caller's library, with this library's automatic differentiation:

    NumPy, lists, anything with __array__ or __dlpack__ -> NumPy
    Dr.Jit arrays and tensors -> TensorXf
    PyTorch tensors -> tensors on the same device; on CUDA a variant of Mitsuba for CUDA must be active, or none yet
    JAX arrays -> JAX arrays, by way of the host

All is computed and given in float32, also for float64 input, whose gradients are float64 again.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from numbers import Real
from typing import Any, overload

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError, require_type, shown
from lingo_mi.common.memory import room
from lingo_mi.functional.frameworks import Argument, call
from lingo_mi.functional.gaussians import Gaussians
from lingo_mi.functional.rays import beams_of, on_host, rays_argument
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors import cutoff
from lingo_mi.projectors import voxelize as voxels
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.usable import require_unfrozen, require_usable
from lingo_mi.projectors.view import View, vector64


@overload
def project(
    means: Gaussians,
    geometry: Geometry,
    /,
    *,
    extent: float | None = None,
    views: Iterable[int] | None = None,
    rays: Any = None,
) -> Any: ...


@overload
def project(
    means: Any,
    scales: Any,
    quaternions: Any,
    density: Any,
    geometry: Geometry,
    *,
    extent: float | None = None,
    views: Iterable[int] | None = None,
    rays: Any = None,
) -> Any: ...


def project(
    means: Any,
    scales: Any = None,
    quaternions: Any = None,
    density: Any = None,
    geometry: Any = None,
    *,
    extent: float | None = None,
    views: Iterable[int] | None = None,
    rays: Any = None,
) -> Any:
    """Line integrals of a cloud of Gaussians along the rays of a scan: images [n, v, u], float32, of the caller's kind.

    Call it as `project(gaussians, geometry)` with a `Gaussians` such as `fit.gaussians`, or with four arrays.

    The arrays are of one library, on one device. With Dr.Jit they may also be Point3f, Vector3f, Vector4f and Float of N. Rays of
    float64 are used in float64. The result is differentiable once in all arrays, in reverse mode, and with Dr.Jit also in forward
    mode. Until it is differentiated, it holds about 100 bytes for each Gaussian in each view, so project only a few views in a
    step of a fit. Derivatives with respect to the rays are exact up to the cut-off.

    Parameters
    ----------
    means
        [N, 3] centres, mm, in the world frame of `lingo_mi.geometry`.
    scales
        [N, 3] standard deviations along the Gaussians' own axes, mm, positive.
    quaternions
        [N, 4] rotations from these axes to the world, (x, y, z, w), of any length but zero.
    density
        [N] values at the centres, in 1/mm for images without a unit.
    geometry
        The scan. Rays run from the source through the pixel centres and beyond, so a virtual panel may be inside the object
        (DSD = DSO). Rays of a parallel beam begin and end at infinity.
    extent : float or None
        Cut-off in standard deviations, 1 to 20 (default: the cut-off of `gaussians`, or 5 for arrays). With 5, images have an
        error of 2e-6 and derivatives of 4e-5 (relative L2 norms, docs/accuracy.md).
    views : Iterable[int] or None
        Indices of the views to project, n of them; None for all.
    rays
        Rays to use instead of `geometry.rays().vectors`, [n, 4, 3], mm: for each of the n views the source (in a parallel beam
        its direction), the corner of the panel, and the steps u and v from pixel to pixel.

    Raises
    ------
    InputError
        For arrays of another shape or of several libraries, an empty cloud, a Gaussian that is not finite, has no extent or no
        rotation, views that the scan does not have, rays that make no view, and arrays on another device than the active
        variant's. Within `jax.jit`, JAX raises its own error with this message for wrong values.

    Examples
    --------
    >>> images = project(means, scales, quaternions, density, geometry, views=[0, 7])
    >>> loss = ((images - measured) ** 2).mean()
    >>> loss.backward()                              # PyTorch
    """
    arrays, geometry, extent = _taken(means, scales, quaternions, density, geometry, extent)
    require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
    height, width = geometry.nDetector
    scan_rays = geometry.rays(curved=True)
    index, options = _indices(views, len(scan_rays)), RenderOptions(extent)
    scan_rays = scan_rays[index]

    def images(means, scales, quaternions, density, vectors=None):
        cloud = gaussians_of((means, scales, quaternions, density), 'project')
        if vectors is None:
            seen = (View.of(scan_rays, i, height, width) for i in range(len(scan_rays)))
        else:
            on_host(vectors, geometry)
            seen = beams_of(vectors, geometry)
        parts = [line_integrals(*cloud, view=view, options=options) for view in seen]
        return parts[0] if len(parts) == 1 else dr.concat(parts)

    shape = len(index), height, width
    _require_room(shape, 'project')
    arguments = _arguments(arrays)
    if rays is not None:
        arguments.append(rays_argument(rays, len(index)))
    return call(images, arguments, shape, 'project')


@overload
def voxelize(means: Gaussians, grid: Grid | Geometry, /, *, extent: float | None = None) -> Any: ...


@overload
def voxelize(
    means: Any, scales: Any, quaternions: Any, density: Any, grid: Grid | Geometry, *, extent: float | None = None
) -> Any: ...


def voxelize(
    means: Any,
    scales: Any = None,
    quaternions: Any = None,
    density: Any = None,
    grid: Any = None,
    *,
    extent: float | None = None,
) -> Any:
    """Densities of a cloud of Gaussians at the voxel centres of a grid: [x, y, z], float32, of the caller's kind.

    Call it as `voxelize(gaussians, grid)`, or with four arrays. Other arguments and errors are as for `project`. The result is
    differentiable in all four arrays, in reverse mode.

    Parameters
    ----------
    grid
        The voxels, or a geometry whose grid is used.

    Examples
    --------
    >>> volume = voxelize(means, scales, quaternions, density, Grid(128, 2.0))
    """
    arrays, grid, extent = _taken(means, scales, quaternions, density, grid, extent)
    require_type('grid', grid, (Grid, Geometry), 'of a scan give scan.geometry.grid')
    grid = grid.grid if isinstance(grid, Geometry) else grid
    corner, step, shape = grid.low, grid.spacing, grid.shape
    _require_room(shape, 'voxelize')

    def volume(*tensors):
        gaussians = gaussians_of(tensors, 'voxelize')
        cells = voxels.Lattice(vector64(corner), vector64(step), shape)
        values = voxels.voxelize(*gaussians, grid=cells, extent=extent, deep=True)
        i, (nx, ny, nz) = dr.arange(mi.UInt32, math.prod(shape)), (dr.opaque(mi.UInt32, n) for n in shape)
        # [z, y, x] to [x, y, z]. Every voxel is read once, so the derivative needs no atomics.
        x, rest = i // (ny * nz), i % (ny * nz)
        return dr.gather(mi.Float, values, (rest % nz * ny + rest // nz) * nx + x, mode=dr.ReduceMode.Permute)

    return call(volume, _arguments(arrays), shape, 'voxelize')


def _taken(means, scales, quaternions, density, where, extent) -> tuple[tuple, Any, float]:
    """The four arrays of a call with arrays or with `Gaussians`, the geometry or grid, and the cut-off."""
    if not isinstance(means, Gaussians):
        return (means, scales, quaternions, density), where, checked_extent(cutoff.RENDER if extent is None else extent)
    if quaternions is not None or density is not None or (scales is not None and where is not None):
        raise InputError('Gaussians hold all four arrays: give them and the geometry or grid alone')
    return tuple(means), scales if where is None else where, checked_extent(means.extent if extent is None else extent)


def _arguments(arrays: Sequence) -> list[Argument]:
    shapes = dict(means=(None, 3), scales=(None, 3), quaternions=(None, 4), density=(None,))
    return [Argument(name, array, shape) for array, (name, shape) in zip(arrays, shapes.items())]


def gaussians_of(tensors: Sequence, name: str) -> list:
    """Point3f, Vector3f, Vector4f and Float [N] of the four arrays, evaluated together.

    They are copies in Dr.Jit's own memory: the kernels that follow would otherwise depend on how the caller's is aligned.

    Raises
    ------
    InputError
        As `require_usable`.
    """
    require_unfrozen(f'lm.{name}')
    flat = [x.array if dr.is_tensor_v(x) else x for x in tensors]
    dr.make_opaque(flat)  # a literal would be compiled in
    columns = []
    for array, tensor, Type in zip(flat, tensors, (mi.Point3f, mi.Vector3f, mi.Vector4f, mi.Float)):
        if dr.is_tensor_v(tensor):
            size, array = dr.size_v(Type) if dr.depth_v(Type) > 1 else 1, mi.Float(array)
            i = dr.arange(mi.UInt32, tensor.shape[0]) * size
            # Every entry is read once, so the derivative needs no atomics.
            array = Type(*(dr.gather(mi.Float, array, i + j, mode=dr.ReduceMode.Permute) for j in range(size)))
        columns.append(Type(array))
    dr.eval(columns)
    require_usable(*columns, where=f'the arrays given to {name}')
    return columns


def _require_room(shape: tuple[int, ...], name: str):
    """Raises InputError for a result that does not fit into this process's memory, or into the 32 bits of Dr.Jit's indices."""
    count, most = math.prod(shape), int(min(room() / 4, 2**32 - 1))
    if count > most:
        size = ' x '.join(map(str, shape))
        raise InputError(
            f'{name}: {size} numbers do not fit into this process, only {most:,}: take fewer views, pixels or voxels'
        )


def checked_extent(extent: Any) -> float:
    """A cut-off in standard deviations.

    Raises
    ------
    InputError
        For one that is none.
    """
    if not (isinstance(extent, Real) and 1 <= float(extent) <= 20):
        raise InputError(f'extent is in standard deviations, from 1 to 20, not {extent!r}')
    return float(extent)


def _indices(views, count: int) -> np.ndarray:
    """Indices of views, int [n], of those that a scan has."""
    if views is None:
        return np.arange(count)
    try:
        views = list(views)
        if any(isinstance(i, bool) for i in views):  # a mask is not a list of indices
            raise TypeError
        indices = [operator.index(i) for i in views]
    except TypeError:
        raise InputError(f'views must be whole numbers, one a view, not {shown(views)}') from None
    if not indices or min(indices) < -count or max(indices) >= count:
        raise InputError(f'views must be at least one number from {-count} to {count - 1}, not {shown(views)}')
    return np.array(indices, int)
