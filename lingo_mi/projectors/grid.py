"""Exact line integrals of a voxel volume, and their exact transpose (Dr.Jit; any llvm or cuda AD variant).

The volume is interpolated trilinearly between voxel centres; in the outer half voxel the edge value is held,
outside the box the density is zero (the convention of Mitsuba's `gridvolume` inside a cube). Between two
consecutive planes through voxel centres, the interpolant along a ray is a cubic polynomial. The two-point
Gauss-Legendre rule from plane to plane is therefore exact: there is no step size, and no error but rounding.
Both points of a segment share the eight corner fetches.

The transpose scatters the same corner weights, so it is the adjoint to rounding. Nothing is stored between
the two.

`line_integrals` is a differentiable function of the volume; `project_volume` and `backproject` run a whole scan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.bent import on_plane, tables

GAUSS = 0.5 / 3**0.5  # abscissae of the two-point rule on [-1/2, 1/2]


# ------------------------------------------------------------------------------------------------------------
#  Rays in grid coordinates: voxel centre i lies at i, the box is [-1/2, n - 1/2]
# ------------------------------------------------------------------------------------------------------------


@dataclass
class Lines:
    """Lines origin + t direction, t in [t_min, t_max].

    Parameters
    ----------
    origin, direction : Point3f, Vector3f
        The direction need not be a unit vector, but must not be zero.
    t_min, t_max
        Numbers or Float, in units of the direction.
    """

    origin: Any
    direction: Any
    t_min: Any = -dr.inf
    t_max: Any = dr.inf


@dataclass
class Walk:
    """The walks of rays through a grid, in its coordinates.

    Parameters
    ----------
    origin : Vector3f
    d, inv : Vector3f
        The direction (no component is zero) and 1 / d.
    t_first, t_last : Float
        Ends of the walk.
    """

    origin: Any
    d: Any
    inv: Any
    t_first: Any
    t_last: Any


def _clip(origin, direction, low, high, t_min, t_max):
    """The walk of a ray through the box [low, high]: (guarded direction, 1 / direction, first and last t)."""
    # A zero component becomes 1e-9 of the largest. Over a thousand voxels this moves the ray by 1e-6 voxel.
    floor = dr.maximum(1e-9 * dr.max(dr.abs(direction)), 1e-30)
    d = dr.select(dr.abs(direction) < floor, dr.copysign(mi.Vector3f(floor), direction), direction)
    inv = dr.rcp(d)
    a, b = (low - origin) * inv, (high - origin) * inv
    return d, inv, dr.maximum(dr.max(dr.minimum(a, b)), t_min), dr.minimum(dr.min(dr.maximum(a, b)), t_max)


def first_planes(origin, direction, t):
    """The next planes that a ray meets after t, the steps to the planes after these, and the cells' offsets."""
    start = dr.fma(direction, t, origin)
    up = direction > 0
    plane = mi.Vector3i(dr.select(up, dr.floor(start) + 1, dr.ceil(start) - 1))
    return plane, mi.Vector3i(dr.select(up, 1, -1)), mi.Vector3i(dr.select(up, -1, 0))


def corners(cell, size):
    """Flat indices of the eight corners of a dual cell, z fastest. Clamping extends the edge values."""
    x0, y0, z0 = (dr.clip(cell[i], 0, n - 1) for i, n in enumerate(size))
    x1, y1, z1 = (dr.clip(cell[i] + 1, 0, n - 1) for i, n in enumerate(size))
    rows = [x * size[1] + y for x in (x0, x1) for y in (y0, y1)]
    return [mi.UInt(row * size[2] + z) for row in rows for z in (z0, z1)]


@dr.syntax
def gather(data: Any, size: tuple[int, int, int], walk: Walk) -> Any:
    """The integral along a ray, in units of t."""
    origin, d, inv, t_last = walk.origin, walk.d, walk.inv, walk.t_last
    t = mi.Float(walk.t_first)
    total = mi.Float(0)
    plane, step, below = first_planes(origin, d, t)
    shift = -origin * inv
    while t < t_last:
        nearest = dr.fma(mi.Vector3f(plane), inv, shift)
        t_next = dr.maximum(dr.minimum(dr.min(nearest), t_last), t)
        cell = plane + below
        f = [dr.gather(mi.Float, data, i) for i in corners(cell, size)]
        length = t_next - t
        middle = dr.fma(0.5, length, t)
        base = origin - mi.Vector3f(cell)
        dz = [f[1] - f[0], f[3] - f[2], f[5] - f[4], f[7] - f[6]]
        both = mi.Float(0)
        for side in (-GAUSS, GAUSS):
            w = dr.fma(d, dr.fma(side, length, middle), base)
            g = [dr.fma(w.z, dz[i], f[2 * i]) for i in range(4)]
            h0 = dr.fma(w.y, g[1] - g[0], g[0])
            h1 = dr.fma(w.y, g[3] - g[2], g[2])
            both += dr.fma(w.x, h1 - h0, h0)
        total = dr.fma(0.5 * length, both, total)
        plane = dr.select(nearest <= t_next, plane + step, plane)
        t = t_next
    return total


def _segment_weights(weight, value, far, d, length, middle):
    """Add a segment to the eight corner weights. Corners are numbered near (0) or far (1) along x, y, z."""
    half = 0.5 * length * value
    for side in (-GAUSS, GAUSS):
        near = dr.fma(-dr.abs(d), dr.fma(side, length, middle), far)
        x, y, z = zip(near, 1 - near)
        for i in range(8):
            weight[i] = dr.fma(half * x[i // 4] * y[i // 2 % 2], z[i % 2], weight[i])


def _cell_address(plane, step, size):
    """Index of a cell's near corner, and offsets to the far corner along each axis, clamped as in `corners`."""
    far = [dr.clip(plane[i], 0, n - 1) for i, n in enumerate(size)]
    near = [dr.clip(plane[i] - step[i], 0, n - 1) for i, n in enumerate(size)]
    stride = (size[1] * size[2], size[2], 1)
    offsets = [(f - n) * s for f, n, s in zip(far, near, stride)]
    return (near[0] * size[1] + near[1]) * size[2] + near[2], offsets


def _leave_cell(target, weight, plane, step, size, on_x, on_y):
    """Write the four corners that do not belong to the ray's exit face. Returns the next cell's weights."""
    index, (x, y, z) = _cell_address(plane, step, size)
    a, b = dr.select(on_x, y, x), dr.select(on_x | on_y, z, y)
    for i in range(4):
        j, k = i // 2, i % 2
        left = dr.select(on_x, weight[2 * j + k], dr.select(on_y, weight[4 * j + k], weight[4 * j + 2 * k]))
        dr.scatter_add(target, left, mi.UInt(index + j * a + k * b), mode=dr.ReduceMode.Direct)
    weights = [(mi.Float(0) if i & bit else weight[i + bit]) for i in range(8) for bit in (4, 2, 1)]
    return [dr.select(on_x, weights[3 * i], dr.select(on_y, weights[3 * i + 1], weights[3 * i + 2])) for i in range(8)]


@dr.syntax
def scatter(target: Any, value: Any, size: tuple[int, int, int], walk: Walk) -> None:
    """The transpose of `gather`: adds `value` times the weight of every corner to `target`.

    The weights of the current cell stay in registers. A step through a face writes the four corners left behind
    and passes the other four on to the next cell, which halves the memory traffic.
    """
    origin, d, inv, t_last = walk.origin, walk.d, walk.inv, walk.t_last
    t = mi.Float(walk.t_first)
    weight = [mi.Float(0) for _ in range(8)]
    plane, step, below = first_planes(origin, d, t)
    shift = -origin * inv
    running = walk.t_first < t_last
    while running:
        running = t < t_last
        nearest = dr.fma(mi.Vector3f(plane), inv, shift)
        leave = dr.min(nearest)
        t_next = dr.maximum(dr.minimum(leave, t_last), t)
        _segment_weights(
            weight, value, (mi.Vector3f(plane) - origin) * mi.Vector3f(step), d, t_next - t, 0.5 * (t_next + t)
        )
        # One face per step: if a ray crosses two planes at once, the second crossing is a segment of length 0. At
        # the end of the ray, two steps along x (the second of length 0) write all eight corners.
        on_x = (nearest.x <= leave) | (t_next >= t_last)
        on_y = ~on_x & (nearest.y <= leave)
        weight = _leave_cell(target, weight, plane, step, size, on_x, on_y)
        plane = plane + dr.select(
            on_x, mi.Vector3i(step.x, 0, 0), dr.select(on_y, mi.Vector3i(0, step.y, 0), mi.Vector3i(0, 0, step.z))
        )
        t = t_next


class _LineIntegrals(dr.CustomOp):
    """Linear in `data`, other inputs are constant. Both derivatives repeat the walk; nothing is stored."""

    def eval(self, data, size, walk):
        self.size, self.walk, self.width = size, walk, dr.width(data)
        return gather(data, size, walk)

    def forward(self):
        self.set_grad_out(gather(self.grad_in('data'), self.size, self.walk))

    def backward(self):
        target = dr.zeros(mi.Float, self.width)
        scatter(target, self.grad_out(), self.size, self.walk)
        self.set_grad_in('data', target)

    def name(self):
        return 'line_integrals'


def walk_along(size, box_min: Any, box_max: Any, lines: Lines, low: Any, high: Any) -> tuple[Walk, Any]:
    """The `Walk` along lines through the part of a grid from `low` to `high`, and the length of a unit of t."""
    origin, direction = lines.origin, lines.direction
    box_min, shape = mi.Point3f(box_min), mi.Vector3f(*size)
    to_grid = shape / (mi.Point3f(box_max) - box_min)
    origin = mi.Vector3f(mi.Point3f(origin) - box_min) * to_grid - 0.5
    length = dr.norm(mi.Vector3f(direction))
    d, inv, first, last = _clip(origin, mi.Vector3f(direction) * to_grid, low, high, lines.t_min, lines.t_max)
    return Walk(origin, d, inv, first, last), length


def whole_box(size: Iterable[int]) -> tuple[Any, Any]:
    """Opposite corners of the grid, in grid coordinates."""
    return mi.Vector3f(-0.5), mi.Vector3f(*size) - 0.5


def line_integrals(data: Any, size: Sequence[int], box_min: Any, box_max: Any, lines: Lines) -> Any:
    """Line integrals of a voxel volume.

    Parameters
    ----------
    data
        mi.Float [nx * ny * nz], z fastest: densities at the voxel centres.
    size : Sequence[int]
        (nx, ny, nz), Python integers.
    box_min, box_max
        Opposite corners of the volume (sequences or mi.Point3f).
    lines : Lines
        Along which, in the volume's unit.

    Returns
    -------
    object
        Mi.Float [lines], density times length: exact for the trilinear interpolant, zero for a ray that misses the box.
        Differentiable with respect to `data` in both modes (the derivative is the same operator or its transpose), not with
        respect to the rays. For full float32 precision, origins should be near the box, as by `view_rays`.

    Raises
    ------
    InputError
        If `data` does not hold nx * ny * nz values.
    """
    nx, ny, nz = (int(n) for n in size)
    size = nx, ny, nz
    if dr.width(data) != nx * ny * nz:
        raise InputError(f'the volume holds {dr.width(data)} values, but its shape says {size}')
    walk, length = walk_along(size, box_min, box_max, lines, *whole_box(size))
    return length * dr.custom(_LineIntegrals, data, size, dr.detach(walk))


# ------------------------------------------------------------------------------------------------------------
#  A whole scan
# ------------------------------------------------------------------------------------------------------------


def view_table(geometry: Geometry, curved: bool = False) -> np.ndarray:
    """The rays of every view as origin and direction, each affine in the pixel position: float32 [view, 19].

    Lengths in mm, relative to the centre of the volume. The columns, in threes: the origin and its steps per
    pixel along u and v; the direction and its steps; last, the smallest t. The origins lie on a plane through
    the volume's centre and are computed in float64, so a distant source costs no float32 precision. Of curved panels, which are
    refused unless `curved`, positions are those on the flat ones that they touch (`bent.on_plane`).
    """
    rays, centre = geometry.rays(curved), np.array(geometry.grid.centre)
    corner, source = rays.corner - centre, rays.source
    normal = np.cross(rays.u, rays.v)
    zero = np.zeros_like(corner)
    if rays.parallel:
        t = -np.sum(corner * source, 1, keepdims=True)
        start = np.full((len(rays), 1), -np.inf)
        rows = [corner + t * source, rays.u, rays.v, source, zero, zero, start]
    else:
        source = source - centre
        axis = corner - source
        t = -np.sum(source * normal, 1, keepdims=True) / np.sum(axis * normal, 1, keepdims=True)
        rows = [source + t * axis, t * rays.u, t * rays.v, axis, rays.u, rays.v, -t]
    return np.concatenate(rows, 1).astype(np.float32)


def view_rays(row: Any, n_v: int, n_u: int, bend: tuple[Any, Any] = (None, None)) -> tuple[Any, Any, Any]:
    """Rays through the pixel centres of a view, v fastest: (origin, direction, t_min).

    row is one row of `view_table` as an evaluated mi.Float [19]; bend the `bent.tables` of that view. Neighbouring lanes are
    neighbours along v, so they cross the same columns of a volume that is stored z fastest. This is twice as fast as the other
    order.
    """
    index = dr.arange(mi.UInt, n_v * n_u)
    column = index // n_v
    return pixel_rays(row, *on_plane(bend, (n_v, n_u), mi.UInt(0), column, index - column * n_v))


def pixel_rays(rows: Any, x: Any, y: Any, view: Any = 0) -> tuple[Any, Any, Any]:
    """Rays through the positions x (along u) and y (along v) of views: (origin, direction, t_min).

    Positions are in pixels, centres at i + 1/2. rows is an evaluated mi.Float [19 n], rows of `view_table`; view says which of
    them, mi.UInt.
    """
    first = view * 19
    v: list[Any] = [mi.Vector3f(*(dr.gather(mi.Float, rows, first + 3 * k + i) for i in range(3))) for k in range(6)]
    return v[0] + x * v[1] + y * v[2], v[3] + x * v[4] + y * v[5], dr.gather(mi.Float, rows, first + 18)


def _occupied(volume):
    """The part of the grid where the interpolant is not zero, in grid coordinates; None if there is none."""
    low, high = [], []
    for axis in range(3):
        used = np.flatnonzero(volume.any(axis=tuple(i for i in range(3) if i != axis)))
        if len(used) == 0:
            return None
        low.append(max(used[0] - 1.0, -0.5))
        high.append(min(used[-1] + 1.0, volume.shape[axis] - 0.5))
    return low, high


def pixel_walk(geometry: Geometry, rows: Any, x: Any, y: Any, view: Any = 0) -> tuple[Walk, Any]:
    """The `Walk` along `pixel_rays` through the whole volume, and the length of a unit of t, in mm."""
    half = mi.Vector3f(*(s / 2 for s in geometry.grid.size))
    return walk_along(
        geometry.grid.shape, -half, half, Lines(*pixel_rays(rows, x, y, view)), *whole_box(geometry.grid.shape)
    )


def view_walk(
    geometry: Geometry, row: Any, low: Any, high: Any, bend: tuple[Any, Any] = (None, None)
) -> tuple[Walk, Any]:
    """The `Walk` along the rays of a view between `low` and `high`, and the length of a unit of t.

    row is one row of `view_table` as an evaluated mi.Float [19]; bend the `bent.tables` of that view.
    """
    half = mi.Vector3f(*(s / 2 for s in geometry.grid.size))
    return walk_along(geometry.grid.shape, -half, half, Lines(*view_rays(row, *geometry.nDetector, bend)), low, high)


def project_volume(
    volume: np.ndarray, geometry: Geometry, progress: Callable[[int, int], None] | None = None
) -> np.ndarray:
    """Projections of a voxel volume along the rays of all pixel centres, exact for its trilinear interpolant.

    Parameters
    ----------
    volume : ndarray [x, y, z]
        Densities per mm, of the shape `geometry.grid.shape`.
    progress : callable or None
        Called as progress(views done, views) after every view.

    Returns
    -------
    ndarray
        Float32 [view, v, u], density times mm. A cone beam starts at the source. Rays do not end at the panel, because the usual
        virtual detector is a panel through the axis (DSD = DSO). Empty margins of the volume cost no time. All views use one
        compiled kernel.

    Raises
    ------
    InputError
        If the shapes disagree or the volume is not finite.
    """
    volume = np.ascontiguousarray(volume, np.float32)
    if volume.shape != geometry.grid.shape:
        raise InputError(
            f'the volume has the shape {volume.shape}, but the geometry says nVoxel = {geometry.grid.shape}'
        )
    if not np.isfinite(volume).all():
        raise InputError('the volume contains NaN or infinity: replace those voxels first')
    out = np.zeros((len(geometry), *geometry.nDetector), np.float32)
    occupied = _occupied(volume)
    if occupied is None:
        return out
    low, high = (dr.opaque(mi.Float, x) for x in occupied[0]), (dr.opaque(mi.Float, x) for x in occupied[1])
    low, high = mi.Vector3f(*low), mi.Vector3f(*high)
    data = mi.Float(volume.ravel())
    curve = geometry.rays(curved=True).curve
    for i, row in enumerate(view_table(geometry, curved=True)):
        bend = tables(curve and curve[[i]], geometry.nDetector[1])
        walk, length = view_walk(geometry, mi.Float(row), low, high, bend)
        out[i] = (length * gather(data, geometry.grid.shape, walk)).numpy().reshape(geometry.nDetector[::-1]).T
        if progress:
            progress(i + 1, len(geometry))
    return out
