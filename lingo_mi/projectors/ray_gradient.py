r"""Derivatives of line integrals of voxels with respect to the rays (Dr.Jit, llvm or cuda).

A sample of a volume f at the point p moves by :math:`\nabla f \cdot \delta p`. The models of `grid` and of `joseph` and
`tilted_joseph` are sums of samples, so what is needed of the volume are a few sums along each ray:

- `exact`: |D| [ integral of f dt ],   p = o + t d:   of f, of its gradient, of t times its gradient; f at both ends
- `Joseph`: path [ sum over slices m of f ],  p = a + b m:   of f, of its slopes in the slice, of m times these

`moving` combines them with the rays, to first order, in Dr.Jit's graph. It goes on to the poses from there, in both modes.

A trilinear or bilinear interpolant has kinks at the planes of voxel centres, and rays of a parallel beam may run within one. The
sums are therefore the mean of two rays, a little off to either side: at a kink, the mean of both slopes. At the faces of the box
the density jumps to zero. The exact model's ends account for that. Joseph's model drops samples there: these jumps, and those
where a ray's main axis changes, have no derivative, and are left out.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.grid import GAUSS, Lines, Walk, corners, first_planes, walk_along, whole_box
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.projectors.stack import Gathered, span
from lingo_mi.projectors.tilted_joseph import Axes, Ray
from lingo_mi.projectors.view import View, vector64

ASIDE = 1.2e-4, 2e-4, 3.2e-4  # voxels: moved by these, rays between voxel centres, along or across, leave their plane


def moving(volume: Any, geometry: Geometry, kind: type[Gathered | GridPair], view: View) -> Any:
    """Line integrals of a volume in one view, Float [u * v], v fastest, that are differentiable in the view's pose.

    Parameters
    ----------
    volume : Float [nx * ny * nz]
        z fastest.
    geometry : Geometry
        The geometry with the grid.
    kind : type[Gathered or GridPair]
        The projector whose model to differentiate.
    """
    half, size = mi.Vector3f(*(s / 2 for s in geometry.grid.size)), geometry.grid.shape
    lines = _lines(view, geometry)
    walk, length = walk_along(size, -half, half, lines, *whole_box(size))
    # The walk keeps zero components away from zero, which would lose their derivative.
    walk.d = dr.replace_grad(walk.d, lines.direction / mi.Vector3f(*geometry.grid.spacing))
    volume = dr.detach(volume)
    if kind is GridPair:
        return _exact(volume, size, walk, length)
    with dr.suspend_grad():
        x, y, z = walk.d
        axes = Axes(mi.Vector3f(x, y, 0 if kind is Joseph else z))
    return _joseph(volume, size, walk, axes, mi.Vector3f(*geometry.grid.spacing))


@full_float64()
def _affine(view: View, centre: Any):
    """Origin and direction of a view's rays, each with its steps along u and v, and the smallest t, as in `grid.view_table`."""
    corner = view.corner - centre
    if view.parallel:
        zero = dr.zeros(type(corner))
        start = corner - dr.dot(corner, view.source) * view.source
        return (start, view.u, view.v), (view.source, zero, zero), -dr.inf
    source = view.source - centre
    axis, normal = corner - source, dr.cross(view.u, view.v)
    t = -dr.dot(source, normal) / dr.dot(axis, normal)
    return (source + t * axis, t * view.u, t * view.v), (axis, view.u, view.v), -t


def _lines(view: View, geometry: Geometry) -> Lines:
    """The rays through the pixel centres of a view, v fastest, relative to the volume's centre."""
    *threes, t_min = _affine(view, vector64(geometry.grid.centre))
    rows = dr.opaque(mi.UInt32, view.height)
    index = dr.arange(mi.UInt32, view.height * view.width)
    column = index // rows
    x: Any = mi.Float(column) + 0.5
    y: Any = mi.Float(index - column * rows) + 0.5
    origin, direction = (mi.Vector3f(a) + x * mi.Vector3f(b) + y * mi.Vector3f(c) for a, b, c in threes)
    return Lines(origin, direction, t_min if view.parallel else mi.Float(t_min))


def _exact(volume, size, walk: Walk, length):
    with dr.suspend_grad():
        sums: Any = [0, 0, 0]
        for side in (-1, 1):
            aside = Walk(walk.origin + side * mi.Vector3f(ASIDE), walk.d, walk.inv, walk.t_first, walk.t_last)
            sums = [s + 0.5 * new for s, new in zip(sums, _integrals(volume, size, aside))]
        hit = walk.t_first < walk.t_last
        first, last = (_value(volume, size, walk.origin + t * walk.d, hit) for t in (walk.t_first, walk.t_last))
        dr.eval(sums, first, last)
    total, slopes, turns = sums
    change = dr.dot(slopes, walk.origin) + dr.dot(turns, walk.d)
    change += dr.select(hit, last * walk.t_last - first * walk.t_first, 0)
    return length * total + dr.detach(length) * change


def _joseph(volume, size, walk: Walk, axes, spacing):
    with dr.suspend_grad():
        sums: Any = [0, 0, 0]
        for side in (-1, 1):
            aside = Ray(walk.origin + side * mi.Vector3f(ASIDE), walk.d, spacing, axes)
            sums = [s + 0.5 * new for s, new in zip(sums, _slices(volume, size, aside))]
        dr.eval(sums)
    total, slopes, turns = sums
    ray = Ray(walk.origin, walk.d, spacing, axes)
    (a1, b1), (a2, b2) = ray.lines
    change = slopes.x * a1 + slopes.y * a2 + turns.x * b1 + turns.y * b2
    return ray.path * total + dr.detach(ray.path) * change


def _value(data, size, point, hit):
    """The trilinear interpolant at a point; edge values are held."""
    cell = dr.floor(point)
    w = point - cell
    f = [dr.gather(mi.Float, data, i, hit) for i in corners(mi.Vector3i(cell), size)]
    for weight in (w.z, w.y, w.x):
        f = [dr.fma(weight, b - a, a) for a, b in zip(f[::2], f[1::2])]
    return f[0]


@dr.syntax
def _integrals(data, size, walk: Walk):
    """Integrals over t along a ray, as `grid.gather`: of f, of its gradient, and of t times its gradient.

    Within a cell these are cubic polynomials, for which the two-point rule is exact.
    """
    origin, d, inv, t_last = walk.origin, walk.d, walk.inv, walk.t_last
    t = mi.Float(walk.t_first)
    total, slopes, turns = mi.Float(0), mi.Vector3f(0), mi.Vector3f(0)
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
        for side in (-GAUSS, GAUSS):
            here = dr.fma(side, length, middle)
            w = dr.fma(d, here, base)
            g = [dr.fma(w.z, dz[i], f[2 * i]) for i in range(4)]
            dy0, dy1 = g[1] - g[0], g[3] - g[2]
            h0, h1 = dr.fma(w.y, dy0, g[0]), dr.fma(w.y, dy1, g[2])
            e0, e1 = dr.fma(w.y, dz[1] - dz[0], dz[0]), dr.fma(w.y, dz[3] - dz[2], dz[2])
            slope = mi.Vector3f(h1 - h0, dr.fma(w.x, dy1 - dy0, dy0), dr.fma(w.x, e1 - e0, e0)) * (0.5 * length)
            total += 0.5 * length * dr.fma(w.x, h1 - h0, h0)
            slopes += slope
            turns += here * slope
        plane = dr.select(nearest <= t_next, plane + step, plane)
        t = t_next
    return total, slopes, turns


@dr.syntax
def _slices(data, size, ray):
    """Sums over the slices m that a ray meets, as `tilted_joseph`: of f, of its slopes in the slice, and of m times these."""
    nx, ny, nz = size
    n, n1, n2 = ray.axes.of([mi.Float(x) for x in size])
    s, s1, s2 = ray.axes.of([mi.UInt(x) for x in (ny * nz, nz, 1)])
    (a1, b1), (a2, b2) = ray.lines
    (low1, high1), (low2, high2) = span(a1, b1, n1), span(a2, b2, n2)
    m = dr.floor(dr.clip(dr.maximum(low1, low2), 0, n))
    last = dr.ceil(dr.clip(dr.minimum(high1, high2), -1, n - 1))
    total, slopes, turns = mi.Float(0), mi.Vector2f(0), mi.Vector2f(0)
    while m <= last:
        y, z = dr.fma(b1, m, a1), dr.fma(b2, m, a2)
        inside = (y >= -0.5) & (y <= n1 - 0.5) & (z >= -0.5) & (z <= n2 - 0.5)
        held_y, held_z = dr.clip(y, 0, n1 - 1), dr.clip(z, 0, n2 - 1)
        j, k = dr.floor(held_y), dr.floor(held_z)
        wy, wz = held_y - j, held_z - k
        near = s * mi.UInt(m) + s1 * mi.UInt(j) + s2 * mi.UInt(k)
        far = near + dr.select(j < n1 - 1, s1, 0)
        up = dr.select(k < n2 - 1, s2, 0)
        p = [dr.gather(mi.Float, data, i, inside) for i in (near, near + up, far, far + up)]
        low, high = dr.fma(wz, p[1] - p[0], p[0]), dr.fma(wz, p[3] - p[2], p[2])
        rise = dr.fma(wy, (p[3] - p[2]) - (p[1] - p[0]), p[1] - p[0])
        slope = mi.Vector2f(dr.select(held_y == y, high - low, 0), dr.select(held_z == z, rise, 0))
        total += dr.fma(wy, high - low, low)
        slopes += slope
        turns += m * slope
        m += 1
    return total, slopes, turns
