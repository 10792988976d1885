r"""Exact path lengths through closed triangle meshes, by drawing every triangle once.

The path of a ray o + tD inside a mesh is \|D\| times the signed sum of the parameters t of its surface crossings: plus
where it leaves, minus where it enters. The order does not matter, so no ray tracing is needed: each triangle adds its
term to the pixel centres that its projection covers.

Neighbouring triangles must not overlap or leave gaps. In a row, a triangle covers the pixels between two of its edges:
from the first pixel centre at or behind the left crossing to the last one before the right crossing. Crossings are
float64 and are always computed from an edge's upper to its lower end, so both triangles of an edge get the same bits.
A triangle's sign in a row depends on which crossing is the left one. The signs at every pixel then sum to exactly zero,
whatever the rounding errors of the crossings.

Therefore t may be measured from any plane. Take the plane through the mesh's centre, parallel to the panel, at t0. Then

    t - t0 = t0 q / (1 - q),   q = 1 - t0 / t

for a cone beam, where q is affine in the pixel position on every triangle. For a parallel beam, t - t0 = q is itself
affine. So float32 holds differences of the size of the mesh, not of the distance to the source. q is computed at the
vertices and interpolated along edges in float64. Along a row it is interpolated in float32, from the end where 1 - q is
smallest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.balance import SHARING, Share, Sharing, Target, Work, pack
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.view import View, vector64

SETUP = 6  # cost of a team's visit to a block of rows, in steps
NEAR = 1e-9  # a mesh touches the source if its nearest vertex has at most this share of the farthest vertex's depth


class MeshPaths:
    """A closed mesh, ready to be projected.

    If parts overlap, their lengths add up.

    Parameters
    ----------
    vertices : array_like
        [V, 3] numbers, any unit; equal positions are merged, because meshes with a normal or texture coordinate per face repeat
        them.
    faces : array_like
        [F, 3] indices of vertices, anticlockwise seen from outside; a mesh that is inside out is flipped as a whole, so all its
        parts must be oriented alike.
    name : str
        For error messages.
    sharing : Sharing
        How the work is shared out (see `balance`).

    Raises
    ------
    InputError
        If the mesh is empty, not finite, or not closed: every edge must be used equally often in both directions.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, name: str, sharing: Sharing = SHARING):
        self.name, self.sharing = name, sharing
        corners, triangles = _closed(np.asarray(vertices, float), np.asarray(faces, np.int64), name)
        Float64 = dr.value_t(mi.Vector3d)
        centre = (corners.min(0) + corners.max(0)) / 2
        self._centre = vector64(centre)
        self._vertices = mi.Vector3d(*(Float64(x) for x in (corners - centre).T))  # relative to the centre
        self._faces = mi.Vector3u(*(mi.UInt32(i) for i in triangles.T.astype(np.uint32)))
        dr.make_opaque(self._vertices, self._faces)

    def lengths(self, view: View) -> Any:
        """Path lengths inside the mesh along the rays of all pixel centres, Float [height * width], row by row.

        A mesh behind the source of a cone beam adds nothing. Not differentiable.

        Parameters
        ----------
        view : View
            `view.View`; the lengths have its unit.

        Raises
        ------
        InputError
            If the mesh crosses the plane of a cone beam's source parallel to the panel, and for a curved panel.
        """
        view.require_flat(f'the mesh {self.name!r}')
        with dr.suspend_grad():
            vertices, t, scale = self._project(view)
            if not view.parallel:
                low, high = dr.min(t)[0], dr.max(t)[0]
                if high <= 0:
                    return dr.zeros(mi.Float, view.height * view.width)
                if low <= NEAR * high:
                    raise InputError(
                        f'the mesh {self.name!r} reaches through the plane of the source, parallel to '
                        'the panel: move the mesh or the source'
                    )
            return self._draw(vertices, view) * mi.Float(scale) * view.lengths()

    @full_float64()
    def _project(self, view):
        """Vertices as Float64 [V * 4], packed (x, y, q, 0); their t, Float64 [V]; the factor from sums to t."""
        Float64 = dr.value_t(mi.Vector3d)
        n = dr.cross(view.u, view.v)
        offset = dr.dot(n, self._vertices)  # along the panel's normal, from the plane at t0
        if view.parallel:
            along = dr.dot(n, view.source)
            q = t = offset / along
            hit = self._centre - view.corner + self._vertices
            hit = hit - view.source * (dr.dot(n, hit) / along)
            scale = dr.sign(along)
        else:
            axis, r = view.corner - view.source, self._centre - view.source + self._vertices
            depth, plane = dr.dot(n, r), dr.dot(n, axis)
            q, t = offset / depth, depth / plane
            hit = r / t - axis
            middle = dr.dot(n, self._centre - view.source) / plane
            scale = middle * dr.sign(plane)
        nn = dr.squared_norm(n)
        x, y = dr.dot(dr.cross(hit, view.v), n) / nn, dr.dot(dr.cross(view.u, hit), n) / nn
        packed = pack(dr.float64_array_t(mi.Vector4f), Float64, (x, y, q, Float64(0)))
        dr.eval(packed, t)
        return packed, t, scale

    def _draw(self, vertices, view):
        """The sum over triangles of sign (t - t0) / t0, or of sign (t - t0) for a parallel beam."""
        height, width = dr.opaque(mi.Int32, view.height), dr.opaque(mi.Int32, view.width)
        triangles, blocks, cost = _plan(vertices, self._faces, height, width, self.sharing)
        drawn: Any = dr.compress(blocks > 0)  # many triangles of fine meshes cover no pixel centre
        if dr.width(drawn) == 0:
            return dr.zeros(mi.Float, view.height * view.width)
        triangles = dr.ravel(dr.gather(mi.Vector4i, triangles, drawn))
        dr.eval(triangles)
        work = Work.of(dr.gather(mi.UInt32, blocks, drawn), dr.gather(mi.UInt32, cost, drawn), self.sharing)
        packets = dr.opaque(mi.Int32, self.sharing.adding.packets(view.width))
        mesh = _Packed(vertices, triangles, height, width, packets, dr.opaque(mi.Float, 0.0 if view.parallel else 1.0))
        return work.add_up(_fill, view.height, view.width, mesh=mesh)


@dataclass
class _Packed:
    """A mesh as a kernel reads it.

    Parameters
    ----------
    vertices : Float64 [V * 4]
        Packed (x, y, q, 0).
    triangles : Int32 [4 T]
        Vertices sorted by y, and the parity of that order.
    height, width : Int32
        Size of the image.
    packets : Int32
        Packets per image row.
    bend : Float
        1 for a cone beam, 0 for a parallel one.
    """

    vertices: Any
    triangles: Any
    height: Any
    width: Any
    packets: Any
    bend: Any

    def corners(self, i: Any) -> Iterator[Any]:
        """The vertices (x, y, q, 0) of a triangle."""
        Vector4d: Any = dr.float64_array_t(mi.Vector4f)
        return (dr.gather(Vector4d, self.vertices, mi.UInt32(k)) for k in (i.x, i.y, i.z))


def from_mitsuba(shape: mi.Shape) -> MeshPaths:
    """The paths through a Mitsuba mesh (`ply`, `obj`, `cube`, `mi.Mesh` ...), in the scene's unit.

    Raises
    ------
    InputError
        If the shape is not a mesh, and as `MeshPaths` does.
    """
    name = shape.id()
    parameters = mi.traverse(shape)
    if not (shape.is_mesh() and 'vertex_positions' in parameters):  # a rectangle is a mesh without them
        raise InputError(f'the shape {name!r} is not a triangle mesh: use a ply, obj or cube shape, for example')
    vertices, faces = (np.array(parameters[key]).reshape(-1, 3) for key in ('vertex_positions', 'faces'))
    return MeshPaths(vertices, faces, name)


# ----------------------------------------------------------------------------------------------------------------------
#  Preparation
# ----------------------------------------------------------------------------------------------------------------------


def _closed(vertices, faces, name):
    """Merged vertices and the remaining faces, oriented outwards. Raises InputError if they do not bound a solid."""
    if any(a.ndim != 2 or a.shape[1] != 3 for a in (vertices, faces)) or not len(faces):
        raise InputError(
            f'the mesh {name!r} needs vertices [V, 3] and at least one face [F, 3], not arrays of shape '
            f'{vertices.shape} and {faces.shape}'
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f'a face of the mesh {name!r} names a vertex that does not exist: there are {len(vertices)}')
    if not np.isfinite(vertices[faces]).all():
        raise InputError(f'a vertex of the mesh {name!r} is not finite: correct or remove it')
    vertices, faces = _merge(vertices, faces)
    if not len(faces):
        raise InputError(f'the mesh {name!r} has no extent: every face has two corners in one place')
    start, end = faces.ravel(), np.roll(faces, -1, 1).ravel()
    count = len(vertices)
    there, back = np.sort(start * count + end), np.sort(end * count + start)
    if not np.array_equal(there, back):
        keys, index = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True)
        unpaired = np.count_nonzero(np.bincount(index, np.where(start < end, 1, -1)))
        raise InputError(
            f'the mesh {name!r} is not closed: {unpaired} of its {len(keys)} edges lack a second face, '
            'or have one that faces the other way; fill its holes and make its normals consistent'
        )
    a, b, c = (vertices[faces] - vertices.mean(0)).transpose(1, 0, 2)
    inside_out = np.sum(np.cross(a, b) * c) < 0
    return vertices, faces[:, ::-1] if inside_out else faces


def _merge(vertices, faces):
    """Merge vertices at the same position. Drop unused vertices, and faces that merging reduces to a line."""
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = vertices[used]
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    is_new = np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)])
    index = np.empty(len(vertices), np.int64)
    index[order] = np.cumsum(is_new) - 1
    faces = index[faces]
    a, b, c = faces.T
    return ordered[is_new], faces[(a != b) & (b != c) & (c != a)]


# ----------------------------------------------------------------------------------------------------------------------
#  Drawing
# ----------------------------------------------------------------------------------------------------------------------


def _first_centre(position, size):
    """The first pixel whose centre is at or behind a position, within [0, size]."""
    return mi.Int32(dr.clip(dr.ceil(position - 0.5), 0, type(position)(size)))


def _plan(vertices, faces, height, width, sharing: Sharing):
    """Per triangle: vertices sorted by y, with the parity of that order; blocks of rows; their cost."""
    Float64 = type(vertices)
    i = [mi.UInt32(k) for k in faces]
    x, y = ([dr.gather(Float64, vertices, 4 * k + axis) for k in i] for axis in range(2))
    area = dr.abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
    reach = _first_centre(dr.maximum(dr.maximum(*x[:2]), x[2]), width) - _first_centre(
        dr.minimum(dr.minimum(*x[:2]), x[2]), width
    )
    odd = mi.Bool(False)
    for j in (0, 1, 0):
        swap = y[j] > y[j + 1]
        odd ^= swap
        y[j], y[j + 1] = dr.select(swap, y[j + 1], y[j]), dr.select(swap, y[j], y[j + 1])
        i[j], i[j + 1] = dr.select(swap, i[j + 1], i[j]), dr.select(swap, i[j], i[j + 1])
    rows = _first_centre(y[2], height) - _first_centre(y[0], height)
    blocks = dr.select(reach > 0, sharing.blocks(mi.UInt32(rows)), 0)
    mean_width = dr.minimum(0.5 * area / (y[2] - y[0]), Float64(reach))
    cost = mi.UInt32(dr.select(blocks > 0, mean_width, 0)) // sharing.step + SETUP
    triangles = pack(mi.Vector4i, mi.Int32, (*(mi.Int32(k) for k in i), dr.select(odd, mi.Int32(-1), 1)))
    dr.eval(triangles, blocks, cost)
    return triangles, blocks, cost


def _edge(a, b):
    """A vertex (x, y, q), and the change of x and q per row towards a second vertex (unused if no row lies between)."""
    return a.x, a.y, a.z, (b.x - a.x) / (b.y - a.y), (b.z - a.z) / (b.y - a.y)


def _cross(edge, y):
    """x and q where an edge meets row y."""
    ax, ay, aq, dx, dq = edge
    # An explicit multiply-add: a compiler that chooses when to fuse could round the same edge in two ways.
    return dr.fma(y - ay, dx, ax), dr.fma(y - ay, dq, aq)


def _row(long, lower, upper, parity, row, row_end, width):
    """A triangle in a row: pixels [first, last), the sign, a pixel `anchor`, q there, and the slope of q."""
    y = type(long[0])(row) + 0.5
    x0, q0 = _cross(long, y)
    is_lower = y < upper[1]
    (x1, q1), (x2, q2) = _cross(lower, y), _cross(upper, y)
    x1, q1 = dr.select(is_lower, x1, x2), dr.select(is_lower, q1, q2)
    # If the order of vertices is even, the long edge runs against y: on the left it belongs to a positive area.
    swap = x0 > x1
    sign = mi.Float(dr.select(swap, -parity, parity))
    first, last = _first_centre(dr.minimum(x0, x1), width), _first_centre(dr.maximum(x0, x1), width)
    # Rows outside the image get no pixels at all: `first` may be invalid there.
    inside = row < row_end
    first, last = dr.select(inside, first, 0), dr.select(inside, last, 0)
    slope = (q1 - q0) / (x1 - x0)
    anchor = dr.select(slope > 0, last - 1, first)
    # From the nearer crossing: one far outside the image would lose digits.
    x = type(y)(anchor) + 0.5
    near = dr.abs(x - x0) < dr.abs(x - x1)
    q = dr.select(near, dr.fma(x - x0, slope, q0), dr.fma(x - x1, slope, q1))
    return first, last, sign, anchor, mi.Float(q), mi.Float(slope)


def _fill(share: Share, target: Target, mesh: _Packed):
    layout = share.layout

    def draw(g, block, stop):
        i = dr.gather(mi.Vector4i, mesh.triangles, g)
        a, b, c = mesh.corners(i)
        long, lower, upper = _edge(a, c), _edge(a, b), _edge(b, c)
        row_begin, row_end = _first_centre(a.y, mesh.height), _first_centre(c.y, mesh.height)

        def rows(row):
            row = row_begin + row
            first, last, sign, anchor, q0, slope = _row(long, lower, upper, i.w, row, row_end, mesh.width)

            origin, line = share.beside(mi.Int32(0), target.base(g) + row * mesh.packets)

            def pixels(packet):
                column: Any = share.elements(packet, origin)
                q: Any = dr.fma(slope, layout.Float(column - anchor), q0)
                value = dr.select((column >= first) & (column < last), sign * q / dr.fma(-mesh.bend, q, 1), 0)
                target.add(value, line + packet)

            share.each_packet(layout.around(first, last), pixels)

        share.each_row(block, stop, row_end - row_begin, rows)

    return share.each_item(draw)
