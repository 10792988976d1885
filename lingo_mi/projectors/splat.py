"""The balanced splat: footprints to an image and back, with work shared out by pixel count.

Each lane works on one detector row of a Gaussian, on a GPU on a half or an eighth of it; `balance` shares the rows out.

The backward pass is a gather: the derivative of a footprint's eleven numbers is a sum over its pixels, kept in registers.
Only the footprints are stored between the two passes.

Each row of a footprint ends exactly at the cut-off and is then widened to whole steps. Forward, backward and tangent
visit the same pixels. So backward is the exact adjoint of tangent, and tangent the exact derivative of forward.

t = dx + shear dy suffers cancellation for an oblique needle: thousands of pixels from its centre, t is a fraction of a
pixel. The kernels therefore store where the ridge t = 0 crosses the row of the centre (`ridge`, in place of the centre's
x). They follow it from row to row with twice float32's digits. Within a row, t is a whole number of pixels from the pixel
on the ridge, less a fraction.

On a curved panel the lanes work on columns instead, and `_InColumn` does what differs: the columns are not whole pixels apart on
the flat panel that footprints refer to, and its pixels s times as long. t is then counted in the curved panel's own pixels, and
where the ridge is in float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

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
    pack_halves,
    times,
    unpack_halves,
    whole,
)
from lingo_mi.projectors.bent import Bend, turned
from lingo_mi.projectors.exponential import HALF_LOG2E, exp2_of_negative
from lingo_mi.projectors.footprint import DOUBLE, NAMES, Footprints

SETUP = 6  # cost of a team's visit to a block of rows, in steps


def splat(
    footprints: Footprints, height: int, width: int, extent: float, parts: int = 1, sharing: Sharing = SHARING
) -> Any:
    """The image of all footprints, Float [height * width], row by row, without the factor |D| of each pixel.

    Differentiable in `footprints.values`, in forward and in reverse mode.

    Parameters
    ----------
    extent : float
        Cut-off in standard deviations.
    parts : int
        Number of partial sums (see `depth`).
    sharing : Sharing
        How the work is shared out (see `balance`).
    """
    return dr.custom(_Splat, footprints.values, replace(footprints, values=()), height, width, extent, parts, sharing)


class _Splat(dr.CustomOp):
    def eval(self, values, rest, height, width, extent, parts, sharing):
        self.plan = Plan(prepare(values, rest, sharing), height, width, extent, sharing, rest.bend)
        self.shear, self.parts = values[3], parts
        return self.plan.image(parts)

    def forward(self):
        tangents: Any = self.grad_in('values')
        self.set_grad_out(self.plan.tangent(tangents, self.shear, self.parts))

    def backward(self):
        self.set_grad_in('values', by_values(self.plan.gradient(self.grad_out()), self.shear))

    def name(self):
        return 'splat'


def prepare(values: Sequence, rest: Footprints, sharing: Sharing) -> tuple:
    """Pack footprints into the evaluated arrays that `Plan` takes. Evaluates the arrays of `rest` with them."""
    amplitude, mx, my, shear, e1, e2, e11, e12, e22, x, y = values
    ridge = x + shear * y
    steps = whole(ridge)
    (high, low), (ridge, ridge_low) = high_low(shear), high_low(ridge - steps)
    columns = (amplitude, mx, my, high, e1, e2, e11, e12, e22, ridge, mi.Float(y), pack_halves(low, ridge_low))
    packed = pack(mi.Vector4f, mi.Float, columns)
    places = pack(mi.Vector4i, mi.Int32, (rest.column + mi.Int32(steps), rest.row, rest.row_begin, rest.row_end))
    blocks = sharing.blocks(rest.row_end - rest.row_begin)
    cost = mi.UInt32(rest.width) // sharing.step + SETUP
    dr.eval(packed, places, blocks, cost, rest)  # in one kernel: otherwise each would project all Gaussians again
    return packed, places, *Work.of(blocks, cost, sharing).arrays


@dataclass
class _Packed:
    """Footprints as a kernel reads them.

    Parameters
    ----------
    numbers : Float [12 N]
        The numbers of `Footprints` with the ridge in place of the centre's x.
    places : Int32 [4 N]
        Column of the ridge, row of the centre, first row and end of the rows.
    extent2 : Float
        The cut-off squared.
    packets : Int32
        Packets per image row.
    bend : Bend or None
        Bend of a curved panel.
    """

    numbers: Any
    places: Any
    extent2: Any
    packets: Any
    bend: Bend | None = None

    def load(self, g):
        """The numbers and the places of footprint g."""
        return load(self.numbers, g), dr.gather(mi.Vector4i, self.places, g)


class Plan:
    """The work of one image: footprints that `prepare` packed, shared out by their pixels. bend: of a curved panel."""

    def __init__(
        self, prepared: Sequence, height: int, width: int, extent: float, sharing: Sharing, bend: Bend | None = None
    ):
        packed, places, *work = prepared
        height, width = (height, width) if bend is None else (width, height)
        self.height, self.width, self.work = height, width, Work(*work, sharing=sharing)
        extent2, packets = dr.opaque(mi.Float, extent * extent), dr.opaque(mi.Int32, sharing.adding.packets(width))
        self.packed = _Packed(packed, places, extent2, packets, bend)

    def image(self, parts: int = 1) -> Any:
        """Float [height * width]."""
        return self._upright(self.work.add_up(_draw, self.height, self.width, parts, f=self.packed))

    def tangent(self, tangents: Sequence, shear: Any, parts: int = 1) -> Any:
        """The image's derivative along `tangents` of `Footprints.values`. shear: one of these values."""
        *others, x, y = tangents
        # In float64: a needle that moves along itself must not move its ridge by rounding.
        ridge = type(shear)(x) + shear * type(shear)(y)
        zeros = dr.zeros(mi.Float, self.work.count)  # a tangent that vanishes has width 1
        moved = pack(mi.Vector4f, mi.Float, [mi.Float(v) + zeros for v in (*others, ridge, y, 0)])
        dr.eval(moved)
        return self._upright(self.work.add_up(_draw, self.height, self.width, parts, f=self.packed, moved=moved))

    def gradient(self, grad_image: Any) -> list:
        """Derivatives by the footprints' numbers, Float [N] each, from the derivative by the image.

        The last, by y, is taken with the ridge fixed; `by_values` converts it.
        """
        if self.packed.bend is not None:
            grad_image = turned(grad_image, self.width, self.height)
        layout, sums = self.work.sharing.reading, Sums(self.work.count, len(NAMES))
        upstream = layout.pad(grad_image, self.height, self.width)
        dr.make_opaque(upstream)
        packed = replace(self.packed, packets=dr.opaque(mi.Int32, layout.packets(self.width)))
        dr.eval(_gather(self.work.shares(layout), packed, upstream, sums), sums.arrays)
        return sums.columns()

    def _upright(self, image):
        """The image row by row: the splat makes the image of a curved panel column by column."""
        return image if self.packed.bend is None else turned(image, self.height, self.width)


def by_values(derivatives: Sequence, shear: Any) -> tuple:
    """Convert the result of `Plan.gradient` to derivatives by `Footprints.values`. shear: one of these values."""
    *others, x, y = derivatives
    y = type(shear)(y) + shear * type(shear)(x)
    return tuple(type(shear)(v) if name in DOUBLE else v for name, v in zip(NAMES, (*others, x, y)))


class _Item:
    """A footprint in a kernel: its numbers, and what follows from them for all rows and pixels."""

    def __init__(self, g, f: _Packed):
        (self.amplitude, self.mx, self.my, self.shear, *e, self.ridge, self.y, low), w = f.load(g)
        self.e1, self.e2, self.e11, self.e12, self.e22 = e
        self.shear_low, self.ridge_low = unpack_halves(low)
        self.column, self.row, self.row_begin, self.row_end = w
        self.extent2, self.packets, self.bend = f.extent2, f.packets, f.bend
        self.half_extent2, self.twice_e12 = 0.5 * f.extent2, 2 * self.e12
        self.a = dr.square(self.mx) - f.extent2 * self.e11
        self.mu = self.mx * HALF_LOG2E**0.5

    def at(self, y) -> _Item:
        """The footprint as its row y sees it."""
        return self if self.bend is None else _InColumn(self, y, self.bend)

    def rows_from_centre(self, y):
        """The distance of row y from the row of the centre, in rows."""
        return mi.Float(y - self.row)

    def on_ridge(self, n):
        """Return the place where t is 0 in a row at that distance: a column and a fraction."""
        along, along_low = times(self.shear, self.shear_low, n)
        steps = whole(along - self.ridge)
        # Near the ridge t needs all its digits; there these differences are exact.
        offset = (self.ridge - (along - steps)) + (self.ridge_low - along_low)
        return self.column - mi.Int32(steps), offset

    def in_its_pixels(self, t, d1):
        """t and d1 in pixels of the footprint."""
        return t, d1

    def moments(self, moments):
        """The moments of a row in t, with t in pixels of the footprint."""
        return moments


class _InColumn(_Item):
    """A footprint as a column y of a curved panel sees it: lengths along the column are in pixels of the curved panel."""

    def __init__(self, i: _Item, y, bend: Bend):
        vars(self).update(vars(i))
        self._place, self._scale = bend.column(y, y < i.row_end)
        self._foot, scale = bend.foot, mi.Float(self._scale)
        self.scale = scale
        self.mx, self.mu, self.e1, self.twice_e12 = i.mx * scale, i.mu * scale, i.e1 * scale, i.twice_e12 * scale
        self.a, self.e11 = i.a * dr.square(scale), i.e11 * dr.square(scale)

    def rows_from_centre(self, y):
        self._n = self._place - (mi.Float64(self.row) + 0.5)
        return mi.Float(self._n)

    def on_ridge(self, n):
        Float64 = mi.Float64
        shear = Float64(self.shear) + Float64(self.shear_low)
        ridge = Float64(self.column) + 0.5 + (Float64(self.ridge) + Float64(self.ridge_low)) - shear * self._n
        element = self._foot + (ridge - self._foot) / self._scale - 0.5
        steps = whole(element)
        return mi.Int32(steps), mi.Float(element - steps)

    def in_its_pixels(self, t, d1):
        return t * self.scale, d1 / self.scale

    def moments(self, moments):
        s, n0, n1, n2, q0, q1, q2 = moments
        square = dr.square(self.scale)
        return s, n0, n1 * self.scale, n2 * square, q0, q1 * self.scale, q2 * square


def _row(layout: Layout, i: _Item, y):
    """Constants of row y of a footprint and its packets [begin, end).

    Returns
    -------
    object
        Dy; m = (my dy)^2; d0 and d1 with den = d0 + t (d1 + e11 t); where t is 0, as a column and a fraction; begin; end.
    """
    n = i.rows_from_centre(y)
    dy = n - i.y
    m = dr.square(i.my * dy)
    d0 = dr.fma(dy, dr.fma(i.e22, dy, i.e2), 1)
    d1 = dr.fma(i.twice_e12, dy, i.e1)
    # num <= extent^2 den, a quadratic in t
    b, c0 = i.half_extent2 * d1, i.extent2 * d0 - m
    root = dr.sqrt(dr.maximum(dr.fma(i.a, c0, b * b), 0))
    column, offset = i.on_ridge(n)
    begin, end = layout.span((b - root) / i.a, (b + root) / i.a, offset, column, y >= i.row_end, i.packets)
    return dy, m, d0, d1, column, offset, begin, end


def _shape(t, i: _Item, m, d0, d1):
    """The footprint without its amplitude: 1/den, the exponent of 2, and den^(-1/2) exp(-num / (2 den)) (`footprint`)."""
    u = i.mu * t
    num = dr.fma(-u, u, m * -HALF_LOG2E)
    root = dr.rsqrt(dr.fma(t, dr.fma(i.e11, t, d1), d0))
    inverse = root * root
    exponent = num * inverse
    return inverse, exponent, root * exp2_of_negative(exponent)


def _draw(share: Share, target: Target, f: _Packed, moved=None):
    """Add all footprints to the target; with `moved`, packed like them, their derivatives in that direction."""

    def draw(g, block, stop):
        item, dc = _Item(g, f), None if moved is None else load(moved, g)

        def rows(row):
            y = item.row_begin + row
            here = item.at(y)
            dy, m, d0, d1, column, offset, first, last = _row(share.layout, here, y)
            column, line = share.beside(column, target.base(g) + y * f.packets)

            def pixels(packet):
                t = share.position(packet, column, offset)
                inverse, exponent, shape = _shape(t, here, m, d0, d1)
                factor = item.amplitude
                if moved is not None:
                    factor = _tangent_factor(item, dc, dy, *here.in_its_pixels(t, d1), inverse, exponent)
                target.add(factor * shape, line + packet)

            share.each_packet((first, last), pixels)

        share.each_row(block, stop, item.row_end - item.row_begin, rows)

    return share.each_item(draw)


def _gather(share: Share, f: _Packed, upstream, derivatives: Sums):
    """Add the derivatives of sum(upstream * image) by the footprints' numbers to `derivatives`."""

    def gather(g, block, stop):
        item = _Item(g, f)

        def rows(row, *sums):
            y = item.row_begin + row
            here = item.at(y)
            dy, m, d0, d1, column, offset, first, last = _row(share.layout, here, y)
            column, line = share.beside(column, y * f.packets)
            total, dot = share.total, share.dot

            def pixels(packet, *moments):
                s, n0, n1, n2, q0, q1, q2 = moments
                t = share.position(packet, column, offset)
                inverse, exponent, shape = _shape(t, here, m, d0, d1)
                # dL/d(num) = -1/2 n and dL/d(den) = -1/2 (n - n num/den), each times the amplitude
                value = share.read(upstream, line + packet) * shape
                n = value * inverse
                q = n * exponent
                nt, qt = n * t, q * t
                # Reduce each packet now: packets of sums do not fit into the CPU's registers.
                return (
                    s + total(value),
                    n0 + total(n),
                    n1 + total(nt),
                    n2 + dot(nt, t),
                    q0 + total(q),
                    q1 + total(qt),
                    q2 + dot(qt, t),
                )

            moments = share.each_packet((first, last), pixels, *(mi.Float(0) for _ in range(7)))
            return _add_row(sums, item, dy, here.moments(moments))

        sums = share.each_row(block, stop, item.row_end - item.row_begin, rows, *(mi.Float(0) for _ in NAMES))
        derivatives.add(sums, g)

    return share.each_item(gather)


def _add_row(sums, i: _Item, dy, moments):
    """Add a row's part to the eleven sums, from its moments in t."""
    s, n0, n1, n2, q0, q1, q2 = moments
    half = -0.5 * i.amplitude
    h0, h1, h2 = (dr.fma(1 / HALF_LOG2E, q, n) for q, n in zip((q0, q1, q2), (n0, n1, n2)))
    n0, n1, n2, h0, h1, h2 = (half * x for x in (n0, n1, n2, h0, h1, h2))
    # The centre enters through t = dx + shear dy and through dy (d0 and d1 are polynomials in dy). The last number is the
    # derivative by the centre's y along the ridge, at constant t.
    d1 = dr.fma(i.twice_e12, dy, i.e1)
    dt = 2 * dr.square(i.mx) * n1 + d1 * h0 + 2 * i.e11 * h1
    ddy = 2 * dr.square(i.my) * dy * n0 + dr.fma(2 * i.e22, dy, i.e2) * h0 + i.twice_e12 * h1
    parts = (
        s,
        2 * i.mx * n2,
        2 * i.my * dr.square(dy) * n0,
        dy * dt,
        h1,
        dy * h0,
        h2,
        2 * dy * h1,
        dr.square(dy) * h0,
        -dt,
        -ddy,
    )
    return tuple(a + b for a, b in zip(sums, parts))


def _tangent_factor(i: _Item, dc, dy, t, d1, inverse, exponent):
    """The footprint's directional derivative over its shape."""
    d_amplitude, d_mx, d_my, d_shear, d_e1, d_e2, d_e11, d_e12, d_e22, d_ridge, d_y, _ = dc
    t_dot = dy * d_shear - d_ridge
    num_dot = 2 * i.mx * t * (d_mx * t + i.mx * t_dot) + 2 * i.my * dy * (d_my * dy - i.my * d_y)
    den_dot = (
        t * (d_e1 + d_e11 * t)
        + dy * (d_e2 + 2 * d_e12 * t + d_e22 * dy)
        + (d1 + 2 * i.e11 * t) * t_dot
        - (i.e2 + 2 * i.e12 * t + 2 * i.e22 * dy) * d_y
    )
    return d_amplitude - 0.5 * i.amplitude * inverse * (num_dot + dr.fma(1 / HALF_LOG2E, exponent, 1) * den_dot)
