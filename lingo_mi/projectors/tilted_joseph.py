"""Joseph's projector and its exact transpose for any panel: turned, tilted, laminography (Dr.Jit, llvm or cuda).

The model is as in `joseph`, but the main axis of a ray may also be z. Nothing is scattered here either: a voxel gathers from
the pixels within the shadow of its neighbours, a rectangle on a flat panel, and computes the weight of each. Before an upright
panel, `joseph` is faster, since a voxel's weights in a column have much in common.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors import bent
from lingo_mi.projectors.grid import view_table
from lingo_mi.projectors.stack import Gathered, hat, lanes, sampled, span
from lingo_mi.projectors.upload import uploaded

RAY = 21  # floats per view of `ray_table`
RUN = 2  # voxels per lane of the transpose
SLACK = 0.01  # pixels that a shadow's border may be off by rounding


def ray_table(geometry: Geometry) -> np.ndarray:
    """The rays of every view as origin and direction, each affine in the pixel position, in voxel indices: float32 [view, 21].

    In threes: the origin and its steps per pixel along u and v; the direction and its steps; the size of a voxel, mm. See
    `grid.view_table`, whose rays these are.
    """
    threes = view_table(geometry, curved=True)[:, :18].astype(float).reshape(-1, 6, 3) / geometry.grid.spacing
    threes[:, 0] += (np.array(geometry.grid.shape) - 1) / 2
    voxel = np.broadcast_to(geometry.grid.spacing, (len(threes), 1, 3))
    return np.concatenate([threes, voxel], 1).reshape(-1, RAY).astype(np.float32)


class TiltedJoseph(Gathered):
    """The matrix A of a scan: see `Gathered`.

    On the device: `rays`, see `ray_table`; `matrices`, see `Geometry.voxel_matrices`; `columns` and `bends`, see `bent.tables`.

    Parameters
    ----------
    valid : ndarray or None
        Bool [view, v, u]; None: all.

    Raises
    ------
    InputError
        For a source beside or inside the volume (see `serves`), or a volume of 2^32 voxels or more.
    """

    ARRAYS = ('rays', 'matrices', 'columns', 'bends', 'valid')

    def __init__(self, geometry: Geometry, valid: np.ndarray | None = None):
        super().__init__(geometry, valid)
        if not self.serves(geometry):
            raise InputError('this projector needs a source that is not beside or inside the volume')
        self.columns, self.bends = bent.tables(geometry.rays(curved=True).curve, self.panel[1])
        self._place(geometry)

    @classmethod
    def serves(cls, geometry: Geometry) -> bool:
        """Return whether this projector can project a scan: all of the volume, and a voxel around it, must lie before the
        source."""
        if geometry.mode == 'parallel':
            return True
        rays, half = geometry.rays(curved=True), np.array(geometry.grid.size) / 2 + geometry.grid.spacing
        signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 1, 3)
        normal = np.cross(rays.u, rays.v)
        ahead = ((geometry.grid.centre + half * signs - rays.source) * normal).sum(-1)
        return bool((ahead / ((rays.corner - rays.source) * normal).sum(-1) > 0).all())

    def of_slab(self, slab: Geometry) -> TiltedJoseph:
        """The matrix of the same scan for other slices of its voxels. slab: see `Geometry.slab`."""
        out = copy(self)
        out.geometry, out.size = slab, slab.grid.shape
        out._place(slab)
        return out

    def _place(self, geometry):
        self.rays = uploaded(ray_table(geometry))
        self.matrices = uploaded(geometry.voxel_matrices())

    def _ray(self, view, u, v):
        """The rays through the centres of pixels."""
        return Ray.through(self.rays, view, *bent.on_plane((self.columns, self.bends), self.panel, view, u, v))

    def _integrate(self, volume, view, u, v):
        return _integrate(volume, self.size, self._ray(view, u, v))

    def _weighted(self, images, block, ones):
        pixels = self.pixels_of(block)
        path = dr.select(self.used(*pixels), self._ray(*pixels).path, 0)
        value = dr.select(path > 0, path * images, 0)  # invalid pixels become 0, whatever stands in them
        return dr.ravel(mi.Vector2f(value, path)) if ones else value

    def _collect(self, weighted, block, ones):
        return _collect(weighted, block.numbers, block.count, self, ones)


class Axes:
    """The main axis of rays, the longest of their direction, and the other two. Ties go to x, then y."""

    def __init__(self, direction):
        x, y, z = dr.abs(direction)
        self.on_x = (x >= y) & (x >= z)
        self.on_y = ~self.on_x & (y >= z)

    def of(self, threes):
        """Three values for x, y and z, as those along the main axis and the others."""
        x, y, z = threes
        main = dr.select(self.on_x, x, dr.select(self.on_y, y, z))
        return main, dr.select(self.on_x, y, x), dr.select(self.on_x | self.on_y, z, y)


def _threes(rays, view):
    return [mi.Vector3f(*(dr.gather(mi.Float, rays, view * RAY + 3 * k + i) for i in range(3))) for k in range(7)]


def _affine(first, step, position):
    return dr.fma(mi.Vector3f(position), step, first)


class Ray:
    """Rays as indices a + b m along the axes that are not the main one, m the index along the main axis.

    Attributes
    ----------
    axes
        `Axes` (default: of the direction).
    lines
        (a, b) of both axes.
    path
        Per slice, mm.
    """

    def __init__(self, origin, direction, voxel, axes: Axes | None = None):
        self.axes = axes or Axes(direction)
        (o, *others), (d, *steps) = self.axes.of(origin), self.axes.of(direction)
        inv = dr.rcp(d)
        slopes = [step * inv for step in steps]
        self.lines = [(dr.fma(-o, b, other), b) for other, b in zip(others, slopes)]
        self.path = dr.norm(direction * voxel) * dr.abs(inv)

    @classmethod
    def through(cls, rays, view, x, y):
        """Through positions on the (flat) panel. rays: see `ray_table`."""
        o, o_u, o_v, d, d_u, d_v, voxel = _threes(rays, view)
        return cls(_affine(_affine(o, o_u, x), o_v, y), _affine(_affine(d, d_u, x), d_v, y), voxel)

    def weight(self, point, size):
        """Return the weight of the voxel with the indices `point`, without the path."""
        m, *indices = self.axes.of(point)
        _, *counts = self.axes.of([mi.Float(n) for n in size])
        first, second = (hat(dr.fma(b, m, a), i, n) for (a, b), i, n in zip(self.lines, indices, counts))
        return first * second


@dr.syntax
def _integrate(data, size, ray: Ray):
    """(A x, A 1) of rays, one per lane."""
    nx, ny, nz = size
    n, n1, n2 = ray.axes.of([mi.Float(x) for x in size])
    s, s1, s2 = ray.axes.of([mi.UInt(x) for x in (ny * nz, nz, 1)])
    (a1, b1), (a2, b2) = ray.lines
    (low1, high1), (low2, high2) = span(a1, b1, n1), span(a2, b2, n2)
    m = dr.floor(dr.clip(dr.maximum(low1, low2), 0, n))
    last = dr.ceil(dr.clip(dr.minimum(high1, high2), -1, n - 1))
    total, count = mi.Float(0), mi.Float(0)
    while m <= last:
        y, z = dr.fma(b1, m, a1), dr.fma(b2, m, a2)
        inside = (y >= -0.5) & (y <= n1 - 0.5) & (z >= -0.5) & (z <= n2 - 0.5)
        total += sampled(data, inside, mi.UInt(m) * s, (y, z), (n1, n2), (s1, s2))
        count += dr.select(inside, 1.0, 0.0)
        m += 1
    return ray.path * total, ray.path * count


def _shadow(r, point) -> Any:
    """Return where the rays that pass within a voxel of `point` in its slice meet the (flat) panel along u and v: shadows as
    for `_pixels`.

    A shift by s moves the shadow along u by (p - u w) s / (w0 + w s), with p and w rows of the projection matrix r and w0 the
    point's value of w. One entry of s, that along the main axis, is zero.
    """
    rows = [r[4 * i : 4 * i + 4] for i in range(3)]
    u0, v0, w0 = (dr.fma(a, point[0], dr.fma(b, point[1], dr.fma(c, point[2], d))) for a, b, c, d in rows)
    w, inv = rows[2], dr.rcp(w0)
    scale = dr.rcp(dr.maximum(w0 - dr.abs(w[0]) - dr.abs(w[1]) - dr.abs(w[2]), 1e-6))
    out = []
    for row, top in ((rows[0], u0 * inv), (rows[1], v0 * inv)):
        x, y, z = (dr.abs(row[i] - top * w[i]) for i in range(3))
        out += [(top, (x + y + z - dr.minimum(dr.minimum(x, y), z)) * scale + (SLACK - 0.5))]
    return out


def _pixels(spot, count):
    """The first and the last pixel with a centre in a shadow, as floats. spot: its middle, and its reach less half a pixel."""
    middle, reach = spot
    return dr.ceil(dr.clip(middle - 1 - reach, 0, count)), dr.floor(dr.clip(middle + reach, -1, count - 1))


def _on_arc(spot, numbers):
    """A shadow along u, as for `_pixels`, on the curved panel. numbers: see `bent.numbers_of`."""
    middle, reach = spot
    low, high = (bent.column_of(numbers, middle + s * (reach + 0.5)) for s in (-1, 1))
    return 0.5 * (low + high), 0.5 * (high - low) + (SLACK - 0.5)


def _at_column(spot, numbers, scale):
    """A shadow along v, as for `_pixels`, in a column of the curved panel whose s is `scale`."""
    middle, reach = spot
    foot, inv = numbers[3], dr.rcp(scale)
    return dr.fma(middle - foot, inv, foot), (reach + 0.5) * inv + (SLACK - 0.5)


@dr.syntax
def _collect(weighted, chosen, n_views, A: TiltedJoseph, ones):
    """See `Gathered`."""
    (nx, ny, nz), (n_v, n_u), rays, matrices = A.size, A.panel, A.rays, A.matrices
    (voxels, exists), (x, y, z0), stride = lanes(A.size, RUN)
    run = len(voxels)
    curved = A.columns is not None
    sums = [[mi.Float(0) for _ in range(2 if ones else 1)] for _ in range(run)]
    block = mi.UInt(0)
    while block < n_views:
        view = dr.gather(mi.UInt, chosen, block)
        r = [dr.gather(mi.Float, matrices, view * 12 + i) for i in range(12)]
        o, o_u, o_v, d, d_u, d_v, voxel = _threes(rays, view)
        numbers: Any = bent.numbers_of(A.bends, view) if curved else None
        for s in range(run):
            z = z0 + s * stride
            along_u, along_v = _shadow(r, (x, y, z))
            u, u_last = _pixels(_on_arc(along_u, numbers) if curved else along_u, n_u)
            v_first, v_last = _pixels(along_v, n_v)
            while u <= u_last:
                X, scale = bent.column(A.columns, A.panel, view, mi.UInt(u)) if curved else (u + 0.5, None)
                first, last = _pixels(_at_column(along_v, numbers, scale), n_v) if curved else (v_first, v_last)
                origin, direction = _affine(o, o_u, X), _affine(d, d_u, X)
                v = mi.Float(first)
                column = (block * n_u + mi.UInt(u)) * n_v
                while v <= last:
                    Y = dr.fma(scale, (v + 0.5) - numbers[3], numbers[3]) if curved else v + 0.5
                    ray = Ray(_affine(origin, o_v, Y), _affine(direction, d_v, Y), voxel)
                    w = ray.weight((x, y, z), (nx, ny, nz))
                    here = column + mi.UInt(v)
                    p = dr.gather(mi.Vector2f, weighted, here) if ones else [dr.gather(mi.Float, weighted, here)]
                    sums[s] = [dr.fma(w, p[j], sums[s][j]) for j in range(2 if ones else 1)]
                    v += 1
                u += 1
        block += 1
    return (voxels, exists), sums
