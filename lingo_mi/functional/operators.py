r"""The exact forward operators of a cloud of Gaussians, on whatever arrays the caller has.

    sigma(x) = sum_i density_i exp(-1/2 |diag(1/scale_i) R_i^T (x - mean_i)|^2)

`project` integrates sigma along the rays of a scan, in closed form (`projectors.footprint`); `voxelize` samples it at the
centres of voxels. What comes out is of the caller's kind, with the caller's automatic differentiation:

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

    Takes `project(gaussians, geometry)`, where `gaussians` is a `Gaussians` such as `fit.gaussians`, or its four arrays:

    The arrays are of one kind, on one device. Dr.Jit's may also be Point3f, Vector3f, Vector4f and Float of N. Rays are computed
    on in float64 where they are that. Differentiable once in all arrays: in reverse mode, in Dr.Jit also in forward mode.
    A result that is to be differentiated holds about 100 bytes for each Gaussian in each view until it is: in a step of a fit,
    project a few views, not all. Derivatives by the rays are exact but for the cut-off.

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
        The scan; its rays run from the source through the pixel centres and on, so that a virtual panel may stand within the
        object (DSD = DSO); those of a parallel beam begin and end at infinity.
    extent : float or None
        Cut-off in standard deviations, 1 to 20 (default: that of `gaussians`, 5 for arrays); with 5, images are good to 2e-6 and
        derivatives to 4e-5 (relative L2 norms, docs/accuracy.md).
    views : Iterable[int] or None
        Indices of the views to project, n of them; None for all.
    rays
        [n, 4, 3] source (of a parallel beam its direction), corner of the panel, and steps u and v from pixel to pixel, of these
        n views, mm, in the place of the geometry's own, which are `geometry.rays().vectors`.

    Raises
    ------
    InputError
        For arrays of another shape or of several kinds, an empty cloud, a Gaussian that is not finite, has no extent or no
        rotation, views that the scan has not, rays that make no view, and arrays on another device than the active variant's.
        Within `jax.jit` what is wrong with values, not with shapes, comes as JAX's own error around the message.

    Examples
    --------
    >>> images = project(means, scales, quaternions, density, geometry, views=[0, 7])
    >>> loss = ((images - measured) ** 2).mean()
    >>> loss.backward()                              # PyTorch
    """
    arrays, geometry, extent = _taken(means, scales, quaternions, density, geometry, extent)
    require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
    height, width = geometry.nDetector
    own = geometry.rays(curved=True)
    index, options = _indices(views, len(own)), RenderOptions(extent)
    own = own[index]

    def images(means, scales, quaternions, density, vectors=None):
        cloud = gaussians_of((means, scales, quaternions, density), 'project')
        if vectors is None:
            seen = (View.of(own, i, height, width) for i in range(len(own)))
        else:
            on_host(vectors, geometry)
            seen = beams_of(vectors, geometry)
        found = [line_integrals(*cloud, view=view, options=options) for view in seen]
        return found[0] if len(found) == 1 else dr.concat(found)

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

    Takes `voxelize(gaussians, grid)`, or four arrays, as `project`.

    The other arguments, and errors, are those of `project`. Differentiable in all four arrays, in reverse mode.

    Parameters
    ----------
    grid
        Or a geometry, whose grid it is.

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
    """Four arrays, where they are projected or sampled, and the cut-off, of a call with arrays or with `Gaussians`."""
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
        found = [operator.index(i) for i in views]
    except TypeError:
        raise InputError(f'views must be whole numbers, one a view, not {shown(views)}') from None
    if not found or min(found) < -count or max(found) >= count:
        raise InputError(f'views must be at least one number from {-count} to {count - 1}, not {shown(views)}')
    return np.array(found, int)
