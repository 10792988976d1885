"""A cloud of Gaussians sampled at the voxel centres of a grid, and the gradient of that.

sigma(x) = sum_i rho_i exp(-1/2 |diag(1/s_i) R_i^T (x - p_i)|^2), the splat's machinery with one more dimension: a lane works
on one line of voxels along x, and the whitened distance is a sum of three squares (a Cholesky factor), so that needles
lose no digits:

    |W delta|^2 = (m1 t)^2 + (m2 (dy + s3 dz))^2 + (m3 dz)^2,   t = dx + s1 dy + s2 dz
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .balance import LANES, PACKET, Work, block_range, deposit, first_item, load, pack, position, span
from .footprint import rotate_inverse
from .splat import LOG2E, SETUP

NUMBERS = 10  # differentiable numbers of a Gaussian: density, m1, m2, m3, s1, s2, s3, x, y, z


@dataclass
class Grid:
    """Voxels: the outer corner of the first one, the step (both Vector3d, opaque) and the number along x, y and z."""

    corner: object
    step: object
    shape: tuple[int, int, int]


def voxelize(centre, scale, rotation, density, grid: Grid, extent: float):
    """Density at the voxel centres, Float [nz * ny * nx], x fastest. Differentiable in the cloud, in reverse mode.

    centre, scale, rotation, density   as for `footprint.project`
    extent                             cut-off in standard deviations
    """
    Vector3d = mi.Vector3d
    Float64 = dr.value_t(Vector3d)
    p, s, rho = Vector3d(centre), Vector3d(scale), Float64(density)
    q = dr.float64_array_t(type(rotation))(rotation)
    q = q * dr.rsqrt(dr.squared_norm(q))
    axes = [rotate_inverse(q, Vector3d(*(float(i == j) for j in range(3)))) for i in range(3)]
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
        whole = [mi.Int32(dr.floor(dr.clip(x, -1e9, 1e9))) for x in at]
        begin = [mi.Int32(dr.clip(dr.ceil(at[i] - half[i] - .5), 0, grid.shape[i])) for i in range(3)]
        end = [mi.Int32(dr.clip(dr.floor(at[i] + half[i] - .5) + 1, 0, grid.shape[i])) for i in range(3)]
        size = [dr.maximum(end[i] - begin[i], 0) for i in range(3)]
        lines = dr.select(size[0] > 0, size[1] * size[2], 0)
        rest = (*whole, lines, begin[1], begin[2], dr.maximum(size[1], 1), mi.Int32(0))
    values = (rho, m1, m2, m3, s1, s2, s3, *(at[i] - Float64(whole[i]) for i in range(3)))
    return dr.custom(_Voxelize, tuple(mi.Float(v) for v in values), rest, mi.UInt32(size[0]), grid.shape, extent)


class _Voxelize(dr.CustomOp):
    def eval(self, values, rest, length, shape, extent):
        self.shape, (nx, ny, nz) = shape, shape
        self.packets = -(-nx // PACKET)
        self.work = Work((mi.UInt32(rest[3]) + (LANES - 1)) // LANES, length // PACKET + SETUP)
        # whole: (column, row, slice, lines) and (first row, first slice, rows, 0)
        packed = pack(mi.Vector4f, mi.Float, (*values, mi.Float(0), mi.Float(0)))
        whole = pack(mi.Vector4i, mi.Int32, rest)
        dr.eval(packed, whole)
        self.arguments = dict(packed=packed, whole=whole, extent2=dr.opaque(mi.Float, extent * extent),
                              packets=dr.opaque(mi.Int32, self.packets), rows=dr.opaque(mi.Int32, ny))
        padded = self.work.add_up(_fill, self.packets * ny * nz, **self.arguments)
        i = dr.arange(mi.UInt32, nx * ny * nz)
        n = dr.opaque(mi.UInt32, nx)
        return dr.gather(mi.Float, padded, i // n * dr.opaque(mi.UInt32, self.packets * PACKET) + i % n)

    def backward(self):
        nx, ny, nz = self.shape
        i = dr.arange(mi.UInt32, self.packets * PACKET * ny * nz)
        padded, n = dr.opaque(mi.UInt32, self.packets * PACKET), dr.opaque(mi.UInt32, nx)
        upstream = dr.gather(mi.Float, self.grad_out(), i // padded * n + i % padded, i % padded < n)
        out = [dr.zeros(mi.Float, self.work.count) for _ in range(NUMBERS)]
        dr.make_opaque(upstream, out)
        dr.eval(_collect(**self.work.shares(), **self.arguments, upstream=upstream, out=out), out)
        self.set_grad_in('values', tuple(out))

    def name(self):
        return 'voxelize'


def _line(c, w, v, index, extent2, packets, rows):
    """A line of voxels of a Gaussian: what is constant along it, its span in packets, and its first packet."""
    _, m1, m2, m3, s1, s2, s3, fx, fy, fz, *_ = c
    y, z = v.x + index % v.z, v.y + index // v.z
    dy, dz = mi.Float(y - w.y) + (.5 - fy), mi.Float(z - w.z) + (.5 - fz)
    slant = dr.fma(s3, dz, dy)
    m = dr.square(m2 * slant) + dr.square(m3 * dz)
    offset = (fx - .5) - (s1 * dy + s2 * dz)
    half = dr.sqrt(dr.maximum(extent2 - m, 0)) / m1
    begin, end = span(-half, half, offset, w.x, (index >= w.w) | (m > extent2), packets)
    return dy, dz, slant, m, offset, begin, end, (z * rows + y) * packets


@dr.syntax
def _fill(lane, begin, end, blocks, block_cost, ends, count, packed, whole, extent2, packets, rows, target, base, private):
    g, start = first_item(begin, end, ends, count)
    while (g < count) & (start < end):
        block, stop = block_range(g, start, begin, end, blocks, block_cost)
        c = load(packed, g)
        w, v = dr.gather(mi.Vector4i, whole, 2 * g), dr.gather(mi.Vector4i, whole, 2 * g + 1)
        while block < stop:
            index = mi.Int32(block * LANES + lane % LANES)
            _, _, _, m, offset, packet, last, line = _line(c, w, v, index, extent2, packets, rows)
            while packet < last:
                u = c[1] * position(packet, w.x, offset)
                deposit(target, c[0] * dr.exp2(dr.fma(u, u, m) * (-.5 * LOG2E)), base + line + packet, private)
                packet += 1
            block += 1
        start = dr.gather(mi.UInt64, ends, g)
        g += 1
    return g


@dr.syntax
def _collect(lane, begin, end, blocks, block_cost, ends, count, packed, whole, extent2, packets, rows, upstream, out):
    g, start = first_item(begin, end, ends, count)
    while (g < count) & (start < end):
        block, stop = block_range(g, start, begin, end, blocks, block_cost)
        c = load(packed, g)
        w, v = dr.gather(mi.Vector4i, whole, 2 * g), dr.gather(mi.Vector4i, whole, 2 * g + 1)
        sums = [mi.Float(0) for _ in range(NUMBERS)]
        while block < stop:
            index = mi.Int32(block * LANES + lane % LANES)
            dy, dz, slant, m, offset, packet, last, line = _line(c, w, v, index, extent2, packets, rows)
            n0, n1, n2 = mi.Vector4f(0), mi.Vector4f(0), mi.Vector4f(0)
            while packet < last:
                t = position(packet, w.x, offset)
                u = c[1] * t
                n = dr.gather(mi.Vector4f, upstream, line + packet) * dr.exp2(dr.fma(u, u, m) * (-.5 * LOG2E))
                nt = n * t
                n0, n1, n2 = n0 + n, n1 + nt, dr.fma(nt, t, n2)
                packet += 1
            sums = _chain(sums, c, dy, dz, slant, dr.sum(n0), dr.sum(n1), dr.sum(n2))
            block += 1
        for i in range(len(out)):
            dr.scatter_add(out[i], sums[i], g, mode=dr.ReduceMode.Local)
        start = dr.gather(mi.UInt64, ends, g)
        g += 1
    return g


def _chain(sums, c, dy, dz, slant, n0, n1, n2):
    """Add a line's part to the sums, from its moments in t: d/d(exponent's square) is -rho/2 times a moment."""
    rho, m1, m2, m3, s1, s2, s3, *_ = c
    a0, a1, a2 = -rho * n0, -rho * n1, -rho * n2
    dt = dr.square(m1) * a1
    d_slant = dr.square(m2) * slant * a0
    d_dy = s1 * dt + d_slant
    d_dz = s2 * dt + s3 * d_slant + dr.square(m3) * dz * a0
    parts = (n0, m1 * a2, m2 * dr.square(slant) * a0, m3 * dr.square(dz) * a0, dy * dt, dz * dt, dz * d_slant,
             -dt, -d_dy, -d_dz)
    return [a + b for a, b in zip(sums, parts)]
