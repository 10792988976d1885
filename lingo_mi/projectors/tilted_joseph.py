"""Joseph's projector and its exact transpose for any flat panel: turned, tilted, laminography (Dr.Jit, llvm or cuda).

The model is that of `joseph`, but the main axis of a ray may also be z. Nothing is scattered here either: a voxel gathers from
the pixels within the shadow of its neighbours, a rectangle, and computes the weight of each. Before an upright panel, `joseph`
is faster, since a voxel's weights in a column have much in common.
"""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
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
    threes = view_table(geometry)[:, :18].astype(float).reshape(-1, 6, 3) / geometry.grid.spacing
    threes[:, 0] += (np.array(geometry.grid.shape) - 1) / 2
    voxel = np.broadcast_to(geometry.grid.spacing, (len(threes), 1, 3))
    return np.concatenate([threes, voxel], 1).reshape(-1, RAY).astype(np.float32)


class TiltedJoseph(Gathered):
    """The matrix A of a scan: see `Gathered`.

    On the device: `rays`, see `ray_table`; `matrices`, see `Geometry.voxel_matrices`.

    Parameters
    ----------
    valid : ndarray or None
        Bool [view, v, u]; None: all.

    Raises
    ------
    InputError
        For a source beside or inside the volume (see `serves`), or a volume of 2^32 voxels or more.
    """

    ARRAYS = ('rays', 'matrices', 'valid')

    def __init__(self, geometry: Geometry, valid: np.ndarray | None = None):
        super().__init__(geometry, valid)
        if not self.serves(geometry):
            raise InputError('this projector needs a source that is not beside or inside the volume')
        self._place(geometry)

    @classmethod
    def serves(cls, geometry: Geometry) -> bool:
        """Whether it can project a scan: all of the volume, and a voxel around it, must lie before the source."""
        if geometry.mode == 'parallel':
            return True
        rays, half = geometry.rays(), np.array(geometry.grid.size) / 2 + geometry.grid.spacing
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

    def _integrate(self, volume, view, u, v):
        return _integrate(volume, self.size, Ray.through(self.rays, view, u, v))

    def _weighted(self, images, block, ones):
        pixels = self.pixels_of(block)
        path = dr.select(self.used(*pixels), Ray.through(self.rays, *pixels).path, 0)
        value = dr.select(path > 0, path * images, 0)  # whatever stands in invalid pixels
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
    def through(cls, rays, view, u, v):
        """Through the centres of pixels. rays: see `ray_table`."""
        o, o_u, o_v, d, d_u, d_v, voxel = _threes(rays, view)
        u, v = mi.Float(u) + 0.5, mi.Float(v) + 0.5
        return cls(_affine(_affine(o, o_u, u), o_v, v), _affine(_affine(d, d_u, u), d_v, v), voxel)

    def weight(self, point, size):
        """Of the voxel with the indices `point`, but for the path."""
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


def _shadow(r, point, counts):
    """The pixels with rays that may pass within a voxel of `point` in its slice: first and last (u, v), as floats.

    A shift by s moves the shadow along u by (p - u w) s / (w0 + w s), with p and w rows of the projection matrix r and w0 the
    point's value of w. One entry of s, that along the main axis, is zero.
    """
    rows = [r[4 * i : 4 * i + 4] for i in range(3)]
    u0, v0, w0 = (dr.fma(a, point[0], dr.fma(b, point[1], dr.fma(c, point[2], d))) for a, b, c, d in rows)
    w, inv = rows[2], dr.rcp(w0)
    scale = dr.rcp(dr.maximum(w0 - dr.abs(w[0]) - dr.abs(w[1]) - dr.abs(w[2]), 1e-6))
    out = []
    for row, top, count in ((rows[0], u0 * inv, counts[0]), (rows[1], v0 * inv, counts[1])):
        x, y, z = (dr.abs(row[i] - top * w[i]) for i in range(3))
        reach = (x + y + z - dr.minimum(dr.minimum(x, y), z)) * scale + (SLACK - 0.5)
        out += [dr.ceil(dr.clip(top - 1 - reach, 0, count)), dr.floor(dr.clip(top + reach, -1, count - 1))]
    return out


@dr.syntax
def _collect(weighted, chosen, n_views, A: TiltedJoseph, ones):
    """See `Gathered`."""
    (nx, ny, nz), (n_v, n_u), rays, matrices = A.size, A.panel, A.rays, A.matrices
    (voxels, exists), (x, y, z0), stride = lanes(A.size, RUN)
    run = len(voxels)
    sums = [[mi.Float(0) for _ in range(2 if ones else 1)] for _ in range(run)]
    block = mi.UInt(0)
    while block < n_views:
        view = dr.gather(mi.UInt, chosen, block)
        r = [dr.gather(mi.Float, matrices, view * 12 + i) for i in range(12)]
        o, o_u, o_v, d, d_u, d_v, voxel = _threes(rays, view)
        for s in range(run):
            z = z0 + s * stride
            u, u_last, v_first, v_last = _shadow(r, (x, y, z), (n_u, n_v))
            while u <= u_last:
                origin, direction = _affine(o, o_u, u + 0.5), _affine(d, d_u, u + 0.5)
                v = mi.Float(v_first)
                column = (block * n_u + mi.UInt(u)) * n_v
                while v <= v_last:
                    ray = Ray(_affine(origin, o_v, v + 0.5), _affine(direction, d_v, v + 0.5), voxel)
                    w = ray.weight((x, y, z), (nx, ny, nz))
                    here = column + mi.UInt(v)
                    p = dr.gather(mi.Vector2f, weighted, here) if ones else [dr.gather(mi.Float, weighted, here)]
                    sums[s] = [dr.fma(w, p[j], sums[s][j]) for j in range(2 if ones else 1)]
                    v += 1
                u += 1
        block += 1
    return (voxels, exists), sums
