"""A cloud of Gaussians sampled at the voxel centres of a grid, and its gradient.

sigma(x) = sum_i rho_i exp(-1/2 |diag(1/s_i) R_i^T (x - p_i)|^2). The method is the splat with one more dimension: a
lane works on one line of voxels along x. The whitened distance is a sum of three squares (a Cholesky factor), so that
needles lose no digits:

    |W delta|^2 = (m1 t)^2 + (m2 r)^2 + (m3 dz)^2,   r = dy + s3 dz,   t = dx + s1 dy + s2 dz

As in the splat, t and r suffer cancellation for oblique needles. The kernels store where t = 0 and r = 0 on the lines
through the centre (`ridge`, in voxels along x, and `spine`, along y). They follow both from line to line with twice float32's
digits. Likewise they sum derivatives by t and r, which stay small; derivatives by dy and dz follow in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.projectors.balance import (
    SHARING,
    Layout,
    Share,
    Sharing,
    Sums,
    Target,
    Work,
    high_low,
    load,
    pack,
    times,
    whole,
)
from lingo_mi.projectors.depth import deepest, parts_of
from lingo_mi.projectors.exponential import HALF_LOG2E, exp2_of_negative
from lingo_mi.projectors.full_float64 import full_float64
from lingo_mi.projectors.rotation import rows_of
from lingo_mi.projectors.splat import SETUP

NUMBERS = 10  # differentiable numbers of a Gaussian: density, m1, m2, m3, s1, s2, s3, x, y, z, the last six in float64


@dataclass
class Lattice:
    """The voxels of a grid on the device.

    Parameters
    ----------
    corner
        Vector3d, opaque: the outer corner of the first voxel.
    step
        Vector3d, opaque: the voxel size.
    shape : tuple[int, int, int]
        Voxels along x, y and z.
    sharing : Sharing
        How the work is shared out (see `balance`).
    """

    corner: Any
    step: Any
    shape: tuple[int, int, int]
    sharing: Sharing = SHARING

    def volume(self, values: Any) -> np.ndarray:
        """Float [nz * ny * nx] as a host volume, float32 [x, y, z]."""
        return np.ascontiguousarray(values.numpy().reshape(self.shape[::-1]).transpose(2, 1, 0))


def voxelize(
    centre: Any, scale: Any, rotation: Any, density: Any, grid: Lattice, extent: float, deep: bool = False
) -> Any:
    """Density at the voxel centres, Float [nz * ny * nx], x fastest. Differentiable in the cloud, in reverse mode.

    Parameters
    ----------
    centre, scale, rotation, density
        As for `footprint.project`; if a Gaussian is not finite, or has a zero scale or quaternion, all voxels become NaN.
    extent : float
        Cut-off in standard deviations.
    deep : bool
        Whether to use partial sums where many Gaussians overlap (see `depth`).
    """
    values, rest, length, covered, sound = _numbers((centre, scale, rotation, density), grid, extent)
    out = dr.custom(_Voxelize, values, rest, length, covered, grid, (extent, deep))
    return out + dr.sum(dr.select(sound, 0, mi.Float(dr.nan)))


@full_float64()
def _numbers(gaussians, grid, extent):
    """Differentiable numbers of all Gaussians, their places, voxels of a line, all voxels (see `_Voxelize`); which are sound."""
    centre, scale, rotation, density = gaussians
    Vector3d = mi.Vector3d
    Float64: Any = dr.value_t(Vector3d)
    p, s, rho = Vector3d(centre), Vector3d(scale), Float64(density)
    Vector4d: Any = dr.float64_array_t(type(rotation))
    axes = rows_of(Vector4d(rotation), Vector3d)
    cx, cy, cz = (axis * (grid.step[i] / s) for i, axis in enumerate(axes))
    m1 = dr.norm(cx)
    s1, s2 = dr.dot(cx, cy) / dr.square(m1), dr.dot(cx, cz) / dr.square(m1)
    cy, cz = cy - s1 * cx, cz - s2 * cx
    m2 = dr.norm(cy)
    s3 = dr.dot(cy, cz) / dr.square(m2)
    m3 = dr.norm(cz - s3 * cy)
    at = (p - grid.corner) / grid.step
    with dr.suspend_grad():
        half = [extent * dr.norm(s * axis) / grid.step[i] for i, axis in enumerate(axes)]
        middle = [mi.Int32(dr.floor(dr.clip(x, -1e9, 1e9))) for x in at]
        begin = [mi.Int32(dr.clip(dr.ceil(at[i] - half[i] - 0.5), 0, grid.shape[i])) for i in range(3)]
        end = [mi.Int32(dr.clip(dr.floor(at[i] + half[i] - 0.5) + 1, 0, grid.shape[i])) for i in range(3)]
        size = [dr.maximum(end[i] - begin[i], 0) for i in range(3)]
        lines = dr.select(size[0] > 0, size[1] * size[2], 0)
        rest = (*middle, lines, begin[1], begin[2], size[1])
        # Voxels of the ellipsoid or of its box, whichever are fewer.
        covered = mi.Float(dr.minimum(4 / 3 * dr.pi * extent**3 / (m1 * m2 * m3), Float64(lines) * Float64(size[0])))
        sound = dr.isfinite(dr.sum(p) + rho + m1 + m2 + m3)
    values = (
        *(mi.Float(v) for v in (rho, m1, m2, m3)),
        s1,
        s2,
        s3,
        *(at[i] - (Float64(middle[i]) + 0.5) for i in range(3)),
    )
    return values, rest, mi.UInt32(size[0]), covered, sound


class _Voxelize(dr.CustomOp):
    def eval(self, values, rest, length, covered, grid, settings):
        shape, (extent, deep) = grid.shape, settings
        self.shape, (nx, ny, nz) = shape, shape
        rho, m1, m2, m3, s1, s2, s3, x, y, z = values
        self.slopes = s1, s2, s3
        ridge, spine = x + s1 * y + s2 * z, y + s3 * z
        along_x, along_y = whole(ridge), whole(spine)
        pairs = [high_low(v) for v in (s1, s2, s3, ridge - along_x, spine - along_y)]
        columns = (rho, m1, m2, m3, *(v for both in pairs for v in both), mi.Float(z), mi.Float(0))
        packed = pack(mi.Vector4f, mi.Float, columns)
        # (column of the ridge, row, slice, lines) and (first row, first slice, rows, row of the spine)
        column, row, *others = rest
        places = pack(mi.Vector4i, mi.Int32, (column + mi.Int32(along_x), row, *others, row + mi.Int32(along_y)))
        sharing = grid.sharing
        blocks, cost = sharing.blocks(mi.UInt32(rest[3])), length // sharing.step + SETUP
        dr.eval(packed, places, blocks, cost, rest, covered)  # in one kernel: each alone would compute all Gaussians
        self.work = Work.of(blocks, cost, grid.sharing)
        parts = parts_of(deepest(rest[:3], covered, shape)) if deep else 1
        extent2, packets = dr.opaque(mi.Float, extent * extent), dr.opaque(mi.Int32, sharing.adding.packets(nx))
        self.packed = _Packed(packed, places, extent2, packets, dr.opaque(mi.Int32, ny))
        return self.work.add_up(_fill, ny * nz, nx, parts, f=self.packed)

    def backward(self):
        nx, ny, nz = self.shape
        layout, sums = self.work.sharing.reading, Sums(self.work.count, NUMBERS)
        upstream = layout.pad(self.grad_out(), ny * nz, nx)
        dr.make_opaque(upstream)
        packed = replace(self.packed, packets=dr.opaque(mi.Int32, layout.packets(nx)))
        dr.eval(_collect(self.work.shares(layout), packed, upstream, sums), sums.arrays)
        out = sums.columns()
        # The kernel's derivatives by y and z are at fixed ridge and spine; the one by s1 is at fixed t where r = 0.
        s1, s2, s3 = self.slopes
        by_s1, by_s2, by_s3, x, y, z = (type(s1)(v) for v in out[4:])
        slopes = by_s1 - s3 * by_s2, by_s2, by_s3
        self.set_grad_in('values', (*out[:4], *slopes, x, y + s1 * x, z + s2 * x + s3 * y))

    def name(self):
        return 'voxelize'


@dataclass
class _Packed:
    """Gaussians as a kernel reads them.

    Parameters
    ----------
    numbers : Float [16 N]
    places : Int32 [8 N]
        Column of the ridge, row, slice, lines; first row, first slice, rows, row of the spine.
    extent2 : Float
        The cut-off squared.
    packets : Int32
        Packets per line of voxels.
    rows : Int32
        Rows per slice.
    """

    numbers: Any
    places: Any
    extent2: Any
    packets: Any
    rows: Any

    def load(self, g):
        """The numbers of Gaussian g, and its places in two parts."""
        c = load(self.numbers, g, 4)
        return c, dr.gather(mi.Vector4i, self.places, 2 * g), dr.gather(mi.Vector4i, self.places, 2 * g + 1)


def _line(layout: Layout, c, w, v, index, f: _Packed):
    """A line of voxels of a Gaussian.

    Returns
    -------
    object
        Its constants dz, r and m; where t is 0, as a column and a fraction; its packets [begin, end); its first packet.
    """
    _, m1, m2, m3, s1, s1_low, s2, s2_low, s3, s3_low, ridge, ridge_low, spine, spine_low, fz, _ = c
    rows_of_slice = dr.maximum(v.z, 1)  # a lane of a finished team reads 0, and an integer division by 0 crashes
    y, z = v.x + index % rows_of_slice, v.y + index // rows_of_slice
    ny, nz = mi.Float(y - w.y), mi.Float(z - w.z)
    dz = nz - fz
    along, low = times(s3, s3_low, nz)
    steps = whole(along - spine)
    r = mi.Float(y - v.w + mi.Int32(steps)) + ((along - steps) - spine) + (low - spine_low)
    m = dr.square(m2 * r) + dr.square(m3 * dz)
    along_y, low_y = times(s1, s1_low, ny)
    along_z, low_z = times(s2, s2_low, nz)
    steps_y = whole(along_y)
    rest, low = _sum(along_y - steps_y, -ridge)
    steps_z = whole(along_z + rest)
    offset = (ridge_low - low_y - low_z - low) - ((along_z - steps_z) + rest)
    column = w.x - mi.Int32(steps_y) - mi.Int32(steps_z)
    half = dr.sqrt(dr.maximum(f.extent2 - m, 0)) / m1
    begin, end = layout.span(-half, half, offset, column, (index >= w.w) | (m > f.extent2), f.packets)
    return dz, r, m, column, offset, begin, end, (z * f.rows + y) * f.packets


def _sum(a, b):
    """a + b and its rounding error (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _fill(share: Share, target: Target, f: _Packed):
    def draw(g, block, stop):
        c, w, v = f.load(g)

        def lines(index):
            _, _, m, column, offset, first, last, line = _line(share.layout, c, w, v, index, f)
            column, line = share.beside(column, target.base(g) + line)

            def voxels(packet):
                u = c[1] * share.position(packet, column, offset)
                value = c[0] * exp2_of_negative(dr.fma(u, u, m) * -HALF_LOG2E)
                target.add(value, line + packet)

            share.each_packet((first, last), voxels)

        share.each_row(block, stop, w.w, lines)

    return share.each_item(draw)


def _collect(share: Share, f: _Packed, upstream, derivatives: Sums):
    def gather(g, block, stop):
        c, w, v = f.load(g)

        def lines(index, *sums):
            dz, r, m, column, offset, first, last, line = _line(share.layout, c, w, v, index, f)
            column, line = share.beside(column, line)

            def voxels(packet, n0, n1, n2):
                t = share.position(packet, column, offset)
                u = c[1] * t
                shape = exp2_of_negative(dr.fma(u, u, m) * -HALF_LOG2E)
                n = share.read(upstream, line + packet) * shape
                nt = n * t
                return n0 + share.total(n), n1 + share.total(nt), n2 + share.dot(nt, t)

            moments = share.each_packet((first, last), voxels, *(mi.Float(0) for _ in range(3)))
            return _add_line(sums, c, dz, r, moments)

        sums = share.each_row(block, stop, w.w, lines, *(mi.Float(0) for _ in range(NUMBERS)))
        derivatives.add(sums, g)

    return share.each_item(gather)


def _add_line(sums, c, dz, r, moments):
    """Add a line's part to the sums, from its moments in t. A derivative by the squared distance is -rho/2 times a moment."""
    n0, n1, n2 = moments
    rho, m1, m2, m3, *_ = c
    a0, a1, a2 = -rho * n0, -rho * n1, -rho * n2
    dt = dr.square(m1) * a1
    d_r = dr.square(m2) * r * a0
    parts = (
        n0,
        m1 * a2,
        m2 * dr.square(r) * a0,
        m3 * dr.square(dz) * a0,
        r * dt,
        dz * dt,
        dz * d_r,
        -dt,
        -d_r,
        -dr.square(m3) * dz * a0,
    )
    return tuple(a + b for a, b in zip(sums, parts))
