"""The balanced splat: footprints to an image and back, with work shared out by pixel count.

A *team* is eight lanes working on one Gaussian at a time, each lane on one detector row, four pixels (a *packet*) at a
step. Teams are few, their number is fixed, and a prefix sum over the Gaussians' costs gives each the same share, so that one
scene-sized Gaussian is shared by all and a launch never changes its size or its kernel.

On the CPU every team owns a copy of the image and adds to it without atomics (which would take most of the time); the
copies are summed at the end. On the GPU there are many teams, one image and atomic additions.

Backward is a gather: the derivative of a footprint's eleven numbers is a sum over its pixels, kept in registers. Nothing is
stored between forward and backward but the footprints.

Each row of a footprint is cut exactly where the cut-off ends, then widened to whole packets. Forward, backward and tangent
visit the same pixels, so they are each other's exact adjoints and derivatives.
"""
from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from .footprint import NAMES, Footprints

LANES = 8    # rows that a team works on side by side
PACKET = 4   # pixels in a step of a lane
SETUP = 6    # cost of a team's visit to eight rows, in packets

LOG2E = 1.4426950408889634


def splat(footprints: Footprints, height: int, width: int, extent: float):
    """The image of all footprints, Float [height * width], row by row, without the factor |D| of each pixel.

    Differentiable in `footprints.values`, in forward and in reverse mode.
    """
    return dr.custom(_Splat, footprints.values, replace(footprints, values=()), height, width, extent)


class _Splat(dr.CustomOp):
    def eval(self, values, rest, height, width, extent):
        self.plan = _Plan(values, rest, height, width, extent)
        return self.plan.image()

    def forward(self):
        count = self.plan.count
        grads = (g if dr.width(g) == count else g + dr.zeros(mi.Float, count) for g in self.grad_in('values'))
        self.set_grad_out(self.plan.tangent(tuple(grads)))

    def backward(self):
        self.set_grad_in('values', self.plan.gradient(self.grad_out()))

    def name(self):
        return 'splat'


class _Plan:
    """The work of one image: packed footprints and the prefix sum of their costs."""

    def __init__(self, values, rest, height, width, extent):
        self.count, self.height, self.width = dr.width(values[0]), height, width
        self.packets = -(-width // PACKET)
        self.extent = dr.opaque(mi.Float, extent)
        self.on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
        self.teams = 4 * dr.thread_count() if self.on_cpu else 4096
        blocks = mi.UInt32(rest.row_end - rest.row_begin + (LANES - 1)) // LANES
        block_cost = mi.UInt32(rest.width) // PACKET + SETUP
        ends = dr.prefix_reduce(dr.ReduceOp.Add, mi.UInt64(blocks) * mi.UInt64(block_cost), exclusive=False)
        self.packed = _pack(mi.Vector4f, mi.Float, (*values, mi.Float(0)))
        self.whole = _pack(mi.Vector4i, mi.Int32, (rest.column, rest.row, rest.row_begin, rest.row_end))
        self.blocks, self.block_cost, self.ends = blocks, block_cost, ends
        dr.eval(self.packed, self.whole, blocks, block_cost, ends)

    def _work(self):
        """Every lane's share: the arguments that all three kernels have in common."""
        total = dr.gather(mi.UInt64, self.ends, self.count - 1)
        lane = dr.arange(mi.UInt32, self.teams * LANES)
        share = total // self.teams + 1
        begin = mi.UInt64(lane // LANES) * share
        return dict(lane=lane, begin=begin, end=dr.minimum(begin + share, total), packed=self.packed, whole=self.whole,
                    blocks=self.blocks, block_cost=self.block_cost, ends=self.ends,
                    count=dr.opaque(mi.UInt32, self.count), extent2=dr.square(self.extent),
                    packets=dr.opaque(mi.Int32, self.packets))

    def image(self):
        return self._add_up(_forward, {})

    def tangent(self, tangents):
        moved = _pack(mi.Vector4f, mi.Float, (*tangents, mi.Float(0)))
        dr.eval(moved)
        return self._add_up(_tangent, dict(moved=moved))

    def _add_up(self, kernel, more):
        """Run a kernel that adds to images, sum the teams' copies and drop the padding."""
        stride = self.packets * self.height
        copies = self.teams if self.on_cpu else 1
        target = dr.zeros(mi.Float, copies * stride * PACKET)
        dr.make_opaque(target)
        work = self._work()
        base = work['lane'] // LANES * dr.opaque(mi.UInt32, stride) if self.on_cpu else mi.UInt32(0)
        dr.eval(kernel(**work, **more, target=target, base=mi.Int32(base), private=self.on_cpu), target)
        i = dr.arange(mi.UInt32, self.height * self.width)
        width = dr.opaque(mi.UInt32, self.width)
        at = i // width * dr.opaque(mi.UInt32, self.packets * PACKET) + i % width
        stride = dr.opaque(mi.UInt32, stride * PACKET)
        result = dr.zeros(mi.Float, self.height * self.width)
        for copy in range(copies):
            result += dr.gather(mi.Float, target, at + copy * stride)
        return result

    def gradient(self, grad_image):
        """Derivatives of the footprints' numbers, a tuple of Float [N], from that of the image."""
        i = dr.arange(mi.UInt32, self.packets * PACKET * self.height)
        padded, width = dr.opaque(mi.UInt32, self.packets * PACKET), dr.opaque(mi.UInt32, self.width)
        row, column = i // padded, i % padded
        upstream = dr.gather(mi.Float, grad_image, row * width + column, column < width)
        out = [dr.zeros(mi.Float, self.count) for _ in NAMES]
        dr.make_opaque(upstream, out)
        dr.eval(_backward(**self._work(), upstream=upstream, out=out), out)
        return tuple(out)


def _pack(Packet, Element, columns):
    """Interleave columns [N] into rows of whole packets, which a lane fetches with few loads."""
    count, packets = dr.width(columns[0]), len(columns) // PACKET
    target = dr.empty(Element, count * packets * PACKET)
    i = dr.arange(mi.UInt32, count)
    for j in range(packets):
        dr.scatter(target, Packet(*columns[PACKET * j:PACKET * (j + 1)]), i * packets + j, mode=dr.ReduceMode.Permute)
    return target


@dr.syntax
def _first(begin, end, ends, count):
    """The Gaussian in which a team's share begins, and where that Gaussian's own work begins."""
    g = mi.UInt32(0)
    size = dr.select(begin < end, count, 0)
    while size > 0:
        middle = g + size // 2
        if dr.gather(mi.UInt64, ends, middle) <= begin:
            g = middle + 1
            size -= size // 2 + 1
        else:
            size //= 2
    return g, dr.gather(mi.UInt64, ends, g - 1, (g > 0) & (begin < end))


def _blocks(g, start, begin, end, blocks, block_cost):
    """The blocks of eight rows of Gaussian g that begin within a team's share."""
    cost = mi.UInt64(dr.gather(mi.UInt32, block_cost, g))
    cost = dr.maximum(cost, 1)  # a masked lane reads 0, and an integer division by it would kill the process
    first = dr.select(begin > start, (dr.maximum(begin, start) - start + cost - 1) // cost, 0)
    last = (dr.maximum(end, start) - start + cost - 1) // cost
    return mi.UInt32(first), mi.UInt32(dr.minimum(mi.UInt64(dr.gather(mi.UInt32, blocks, g)), last))


def _load(g, packed):
    """The eleven numbers of Gaussian g, in the order of footprint.NAMES."""
    return [x for j in range(3) for x in dr.gather(mi.Vector4f, packed, g * 3 + j)][:len(NAMES)]


def _row(c, whole, y, extent2, packets):
    """Constants of row y of a footprint and its packets [begin, end).

    Returns dy, m = (my dy)^2, d0 and d1 with den = d0 + t (d1 + e11 t), the t of pixel centre 0, begin and end.
    """
    _, mx, my, shear, e1, e2, e11, e12, e22, fx, fy = c
    dy = mi.Float(y - whole.y) + (.5 - fy)
    m = dr.square(my * dy)
    d0 = dr.fma(dy, dr.fma(e22, dy, e2), 1)
    d1 = dr.fma(2 * e12, dy, e1)
    # num <= extent^2 den, a quadratic in t
    a, b, c0 = dr.square(mx) - extent2 * e11, .5 * extent2 * d1, extent2 * d0 - m
    root = dr.sqrt(dr.maximum(dr.fma(a, c0, b * b), 0))
    offset = (fx - .5) - shear * dy
    far = 1e8
    low = mi.Int32(dr.clip(dr.ceil((b - root) / a + offset), -far, far)) + whole.x
    high = mi.Int32(dr.clip(dr.floor((b + root) / a + offset), -far, far)) + whole.x
    empty = (y >= whole.w) | (high < low) | (high < 0)
    begin = dr.maximum(low, 0) // PACKET
    end = dr.select(empty, begin, dr.minimum(high // PACKET + 1, packets))
    return dy, m, d0, d1, offset, begin, end


def _position(packet, whole, offset):
    """t of the four pixels of a packet."""
    t = mi.Float(packet * PACKET - whole.x) - offset
    return mi.Vector4f(t, t + 1, t + 2, t + 3)


def _shape(t, mx, m, d0, d1, e11):
    """The footprint without its amplitude: 1/den, num/den and den^(-1/2) exp(-num / (2 den))."""
    u = mx * t
    num = dr.fma(u, u, m)
    root = dr.rsqrt(dr.fma(t, dr.fma(e11, t, d1), d0))
    inverse = root * root
    ratio = num * inverse
    return inverse, ratio, root * dr.exp2(ratio * (-.5 * LOG2E))


@dr.syntax
def _forward(lane, begin, end, packed, whole, blocks, block_cost, ends, count, extent2, packets, target, base, private):
    g, start = _first(begin, end, ends, count)
    while (g < count) & (start < end):
        block, stop = _blocks(g, start, begin, end, blocks, block_cost)
        c = _load(g, packed)
        w = dr.gather(mi.Vector4i, whole, g)
        while block < stop:
            y = w.z + mi.Int32(block * LANES + lane % LANES)
            dy, m, d0, d1, offset, packet, last = _row(c, w, y, extent2, packets)
            line = base + y * packets
            while packet < last:
                t = _position(packet, w, offset)
                _, _, shape = _shape(t, c[1], m, d0, d1, c[6])
                value = c[0] * shape
                if dr.hint(private, mode='scalar'):
                    dr.scatter(target, dr.gather(mi.Vector4f, target, line + packet) + value, line + packet)
                else:
                    dr.scatter_add(target, value, line + packet)
                packet += 1
            block += 1
        start = dr.gather(mi.UInt64, ends, g)
        g += 1
    return g


@dr.syntax
def _backward(lane, begin, end, packed, whole, blocks, block_cost, ends, count, extent2, packets, upstream, out):
    g, start = _first(begin, end, ends, count)
    while (g < count) & (start < end):
        block, stop = _blocks(g, start, begin, end, blocks, block_cost)
        c = _load(g, packed)
        w = dr.gather(mi.Vector4i, whole, g)
        sums = [mi.Float(0) for _ in NAMES]
        while block < stop:
            y = w.z + mi.Int32(block * LANES + lane % LANES)
            dy, m, d0, d1, offset, packet, last = _row(c, w, y, extent2, packets)
            line = y * packets
            s, n0, n1, n2 = mi.Vector4f(0), mi.Vector4f(0), mi.Vector4f(0), mi.Vector4f(0)
            h0, h1, h2 = mi.Vector4f(0), mi.Vector4f(0), mi.Vector4f(0)
            while packet < last:
                t = _position(packet, w, offset)
                inverse, ratio, shape = _shape(t, c[1], m, d0, d1, c[6])
                # dL/d(num) = -1/2 n and dL/d(den) = -1/2 h, but for the amplitude
                value = dr.gather(mi.Vector4f, upstream, line + packet) * shape
                n = value * inverse
                h = n * (1 - ratio)
                s, n0, h0 = s + value, n0 + n, h0 + h
                nt, ht = n * t, h * t
                n1, h1 = n1 + nt, h1 + ht
                n2, h2 = dr.fma(nt, t, n2), dr.fma(ht, t, h2)
                packet += 1
            sums = _chain(sums, c, dy, *(dr.sum(x) for x in (s, n0, n1, n2, h0, h1, h2)))
            block += 1
        for i in range(len(out)):
            dr.scatter_add(out[i], sums[i], g, mode=dr.ReduceMode.Local)
        start = dr.gather(mi.UInt64, ends, g)
        g += 1
    return g


def _chain(sums, c, dy, s, n0, n1, n2, h0, h1, h2):
    """Add a row's part to the eleven sums, from its moments in t."""
    amplitude, mx, my, shear, e1, e2, e11, e12, e22, _, _ = c
    half = -.5 * amplitude
    n0, n1, n2, h0, h1, h2 = (half * x for x in (n0, n1, n2, h0, h1, h2))
    # t and dy are where the centre enters: t = dx + shear dy, d0 and d1 are polynomials of dy.
    d1 = dr.fma(2 * e12, dy, e1)
    dt = 2 * dr.square(mx) * n1 + d1 * h0 + 2 * e11 * h1
    ddy = 2 * dr.square(my) * dy * n0 + dr.fma(2 * e22, dy, e2) * h0 + 2 * e12 * h1 + shear * dt
    parts = (s, 2 * mx * n2, 2 * my * dr.square(dy) * n0, dy * dt, h1, dy * h0, h2, 2 * dy * h1, dr.square(dy) * h0,
             -dt, -ddy)
    return [a + b for a, b in zip(sums, parts)]


@dr.syntax
def _tangent(lane, begin, end, packed, whole, blocks, block_cost, ends, count, extent2, packets, moved, target, base,
             private):
    g, start = _first(begin, end, ends, count)
    while (g < count) & (start < end):
        block, stop = _blocks(g, start, begin, end, blocks, block_cost)
        c, dc = _load(g, packed), _load(g, moved)
        w = dr.gather(mi.Vector4i, whole, g)
        while block < stop:
            y = w.z + mi.Int32(block * LANES + lane % LANES)
            dy, m, d0, d1, offset, packet, last = _row(c, w, y, extent2, packets)
            line = base + y * packets
            while packet < last:
                t = _position(packet, w, offset)
                inverse, ratio, shape = _shape(t, c[1], m, d0, d1, c[6])
                value = shape * _tangent_factor(c, dc, t, dy, d1, inverse, ratio)
                if dr.hint(private, mode='scalar'):
                    dr.scatter(target, dr.gather(mi.Vector4f, target, line + packet) + value, line + packet)
                else:
                    dr.scatter_add(target, value, line + packet)
                packet += 1
            block += 1
        start = dr.gather(mi.UInt64, ends, g)
        g += 1
    return g


def _tangent_factor(c, dc, t, dy, d1, inverse, ratio):
    """The footprint's directional derivative over its shape."""
    amplitude, mx, my, shear, e1, e2, e11, e12, e22, _, _ = c
    d_amplitude, d_mx, d_my, d_shear, d_e1, d_e2, d_e11, d_e12, d_e22, d_x, d_y = dc
    t_dot = dy * d_shear - d_x - shear * d_y
    num_dot = 2 * mx * t * (d_mx * t + mx * t_dot) + 2 * my * dy * (d_my * dy - my * d_y)
    den_dot = (t * (d_e1 + d_e11 * t) + dy * (d_e2 + 2 * d_e12 * t + d_e22 * dy)
               + (d1 + 2 * e11 * t) * t_dot - (e2 + 2 * e12 * t + 2 * e22 * dy) * d_y)
    return d_amplitude - .5 * amplitude * inverse * (num_dot + (1 - ratio) * den_dot)
