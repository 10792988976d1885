"""Load balancing of uneven work: a fixed number of teams, each with the same share of the total cost.

An *item* (a Gaussian, a triangle) consists of *blocks* of rows. All blocks of an item have the same cost, and a prefix sum
gives the end of each item's cost. A *team* of lanes works on one item at a time, block by block, and in every row step by step.
Each team takes the blocks that begin within its share of the total cost. So all teams share a huge item, an empty item costs
nothing, and launch size and kernel never change.

A `Layout` says which lane works on what. On the CPU a team has eight lanes, one row each, and a step is a packet of four
elements. Each team adds to its own image without atomics (which would take most of the time), and the copies are summed at the
end, unless they would be too large.

On a GPU a team is a warp, and all teams add to one image, with atomics. The lanes of a row stand side by side on the eight
elements of a sector, 32 bytes, which is what memory moves. Sixteen rows of two lanes with four elements each take the least work.
But before compute capability 9.0 atomics take one element a lane at a time, so that a sector would move four times: to add, there
are four rows of eight lanes with one element each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.gpu import gpu, resident_warps
from lingo_mi.projectors.depth import hashed

while_loop: Any = dr.while_loop  # it is declared for loops with one variable

PACKET = 4  # numbers of an item that a lane loads at once
MOST_PARTS = 256  # images, each of a part of the items, in one launch
MOST_COPIED = 1 << 25  # packets in all copies of a target (512 MB); a larger one is shared, with atomics


@dataclass(frozen=True)
class Layout:
    """The lanes of a team: `rows` rows of `columns` lanes, each with a packet of `size` consecutive elements at a time."""

    rows: int
    columns: int
    size: int

    @property
    def lanes(self) -> int:
        return self.rows * self.columns

    @property
    def step(self) -> int:
        """Elements of a row that a team works on at once."""
        return self.columns * self.size

    def packets(self, width: int) -> int:
        """Packets of a row of `width` elements, in whole steps."""
        return -(-width // self.step) * self.columns

    def pad(self, image: Any, rows: int, width: int) -> Any:
        """Float [rows * width] with zeros at the end of each row, up to whole steps."""
        padded = self.packets(width) * self.size
        if padded == width:
            return image
        i = dr.arange(mi.UInt32, rows * padded)
        pitch, columns = dr.opaque(mi.UInt32, padded), dr.opaque(mi.UInt32, width)
        row, column = i // pitch, i % pitch
        return dr.gather(mi.Float, image, row * columns + column, column < columns)

    def crop(self, padded: Any, rows: int, width: int) -> Any:
        """The inverse of `pad`."""
        pitch = self.packets(width) * self.size
        if pitch == width:
            return padded
        i, columns = dr.arange(mi.UInt32, rows * width), dr.opaque(mi.UInt32, width)
        return dr.gather(mi.Float, padded, i // columns * dr.opaque(mi.UInt32, pitch) + i % columns)

    def span(self, low: Any, high: Any, offset: Any, column: Any, empty: Any, packets: Any) -> tuple[Any, Any]:
        """The packets [begin, end) of a row that cover t in [low, high], where t = 0 is at the element column + offset.

        `begin` is where a step begins.
        """
        far = 1e8  # keeps distant positions within Int32
        first = mi.Int32(dr.clip(dr.ceil(low + offset), -far, far)) + column
        last = mi.Int32(dr.clip(dr.floor(high + offset), -far, far)) + column
        begin = self._step_of(dr.maximum(first, 0))
        empty |= (last < first) | (last < 0)
        return begin, dr.select(empty, begin, dr.minimum(last // self.size + 1, packets))

    def around(self, first: Any, last: Any) -> tuple[Any, Any]:
        """The packets [begin, end) of the elements [first, last) of a row; `begin` is where a step begins."""
        return self._step_of(first), (last + (self.size - 1)) // self.size

    def _step_of(self, element):
        """The first packet of the step that an element is in."""
        packet = element // self.size
        return packet if self.columns == 1 else packet & -self.columns

    @property
    def Float(self) -> Any:
        """The type of a packet."""
        return mi.Float if self.size == 1 else mi.Vector4f


PAIRS, EIGHTS = Layout(16, 2, 4), Layout(4, 8, 1)  # on a GPU


@dataclass(frozen=True)
class Sharing:
    """The number of shares, and the width of the teams that do one share each. Images do not depend on it, but for rounding.

    Parameters
    ----------
    lanes : int
        Lanes of a team on the CPU; on a GPU it is a warp.
    shares : float
        Shares over their usual number, which is two a CPU thread, or as many as a GPU can hold warps. More shares balance better,
        but on the CPU each has its own image.
    """

    lanes: int = 8
    shares: float = 1

    def scaled(self, factor: float) -> Sharing:
        """`factor` times as many shares."""
        return replace(self, shares=factor * self.shares)

    @property
    def adding(self) -> Layout:
        """The layout of kernels that add to an image."""
        if _on_cpu():
            return Layout(self.lanes, 1, PACKET)
        return PAIRS if gpu().capability >= 90 else EIGHTS

    @property
    def reading(self) -> Layout:
        """The layout of kernels that read from an image. Its steps are as wide as the steps of `adding`."""
        return self.adding if _on_cpu() else PAIRS

    @property
    def teams(self) -> int:
        return max(round(self.shares * (2 * dr.thread_count() if _on_cpu() else resident_warps())), 1)

    @property
    def step(self) -> int:
        """Elements of a step."""
        return self.adding.step

    @property
    def block(self) -> int:
        """Rows of a block, at least as many as a team has."""
        return self.reading.rows

    def blocks(self, rows: Any) -> Any:
        """Blocks of an item with so many rows, UInt32."""
        return mi.UInt32(rows + (self.block - 1)) // self.block


def _on_cpu() -> bool:
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM


SHARING = Sharing()  # as measured: docs/tables/accuracy_shares_of_the_work.csv


@dataclass
class Share:
    """The work of a kernel's lanes.

    Parameters
    ----------
    lane : UInt32
        Lane numbers; a team has consecutive ones.
    begin, end : tuple
        Ends of the team's share, as (item, block), UInt32.
    blocks : UInt32 [N]
        Blocks of each item.
    layout : Layout
        Layout of the teams.
    block : int
        Rows of a block.
    """

    lane: Any
    begin: tuple
    end: tuple
    blocks: Any
    layout: Layout
    block: int

    def __post_init__(self):
        rows, columns = self.layout.rows, self.layout.columns
        self.row, self.column = self.lane // columns % rows, mi.Int32(self.lane % columns)

    def each_row(self, first: Any, stop: Any, count: Any, visit: Callable[..., Any], *state: Any) -> tuple:
        """`for row in the lane's rows of blocks [first, stop): state = visit(row, *state)`, of an item with `count` rows.

        On the CPU, where all lanes go on together, there may be rows past the end. Returns the last state.
        """
        rows = self.layout.rows
        if rows == self.block:
            return repeat(first, stop, lambda block, *state: visit(mi.Int32(block * rows + self.row), *state), *state)
        begin = mi.Int32(first * self.block + self.row)
        return repeat(begin, dr.minimum(mi.Int32(stop * self.block), mi.Int32(count)), visit, *state, by=rows)

    def each_packet(self, span: tuple, visit: Callable[..., Any], *state: Any) -> tuple:
        """`for packet in range(*span): state = visit(packet, *state)`, for lane 0 of a row, in steps. Returns the last state."""
        return repeat(*span, visit, *state, by=self.layout.columns)

    def beside(self, column: Any, line: Any) -> tuple[Any, Any]:
        """A column and the first packet of a line, as the lane sees them that counts packets like lane 0 of the row."""
        if self.layout.columns == 1:
            return column, line
        return column - self.column * self.layout.size, line + self.column

    def elements(self, packet: Any, column: Any) -> Any:
        """Numbers of a packet's elements, counted from `column`: Int32 or Vector4i."""
        first = packet * self.layout.size - column
        return first if self.layout.size == 1 else first + mi.Vector4i(0, 1, 2, 3)

    def position(self, packet: Any, column: Any, offset: Any) -> Any:
        """t of a packet's elements, with full precision near t = 0, which is at the element column + offset."""
        whole = mi.Float(packet * self.layout.size - column)
        if self.layout.size == 1:
            return whole - offset
        return mi.Vector4f(whole - offset, (whole + 1) - offset, (whole + 2) - offset, (whole + 3) - offset)

    def read(self, image: Any, packet: Any) -> Any:
        """A packet of an image, counted from its start: Float or Vector4f."""
        return dr.gather(self.layout.Float, image, packet)

    def total(self, elements: Any) -> Any:
        """The sum of a lane's elements, Float."""
        return elements if self.layout.size == 1 else dr.sum(elements)

    def dot(self, a: Any, b: Any) -> Any:
        """The sum of the products of a lane's elements, Float."""
        return a * b if self.layout.size == 1 else dr.dot(a, b)

    def each_item(self, visit: Callable[[Any, Any, Any], None]) -> Any:
        """Call visit(g, block, stop) for each item of the share, with its range of blocks. Returns the kernel's result.

        Loop states hold only variables that change: otherwise Dr.Jit traces a loop twice, and nested ones 4 or 8 times.
        """
        end = self.end

        def step(g, block):
            visit(g, block, dr.select(g < end[0], dr.gather(mi.UInt32, self.blocks, g), end[1]))
            return g + 1, mi.UInt32(0)

        return while_loop(self.begin, lambda g, block: (g < end[0]) | (g == end[0]) & (block < end[1]), step)[0]


@dataclass
class Target:
    """The images that a kernel adds packets to.

    Parameters
    ----------
    values : Float
        The images of all teams, or common ones.
    size : Int32
        Packets of an image.
    team : UInt32
        Team with an image of its own, which needs no atomics; None: the images are common.
    parts : int
        Common images, each of a part of the items.
    """

    values: Any
    size: Any
    team: Any
    parts: int

    def base(self, item: Any) -> Any:
        """The first packet of the image to add an item to, Int32."""
        if self.team is not None:
            return mi.Int32(self.team * self.size)
        if self.parts == 1:
            return mi.Int32(0)
        return mi.Int32(hashed(item) // 256 % dr.opaque(mi.UInt32, self.parts)) * self.size

    def add(self, value: Any, packet: Any) -> None:
        """Add a packet, Vector4f or Float, counted from the start of `values`."""
        # On a GPU no two lanes of a warp meet: there is nothing to add up before the atomics.
        shared = dr.ReduceMode.Auto if _on_cpu() else dr.ReduceMode.Direct
        mode = shared if self.team is None else dr.ReduceMode.NoConflicts
        dr.scatter_add(self.values, value, packet, mode=mode)


class Sums:
    """`count` sums for each of N items, to which the lanes of all teams add."""

    def __init__(self, items: int, count: int):
        self.count, self.packed = count, not _on_cpu()
        # A GPU's lanes add up among themselves before the atomics, four sums at once.
        shape = [items * PACKET] * -(-count // PACKET) if self.packed else [items] * count
        self.arrays = [dr.zeros(mi.Float, n) for n in shape]
        dr.make_opaque(self.arrays)

    def add(self, values: Sequence, item: Any) -> None:
        if not self.packed:
            for array, value in zip(self.arrays, values):
                dr.scatter_add(array, value, item, mode=dr.ReduceMode.Local)
            return
        values = [*values, *(mi.Float(0) for _ in range(-len(values) % PACKET))]
        for j, array in enumerate(self.arrays):
            dr.scatter_add(array, mi.Vector4f(*values[PACKET * j : PACKET * (j + 1)]), item, mode=dr.ReduceMode.Local)

    def columns(self) -> list:
        """The sums, Float [N] each."""
        if not self.packed:
            return self.arrays
        i = dr.arange(mi.UInt32, dr.width(self.arrays[0]) // PACKET)
        columns = [x for array in self.arrays for x in dr.gather(mi.Vector4f, array, i)]
        return columns[: self.count]


class Work:
    """Items shared out among teams, from evaluated arrays:

    Parameters
    ----------
    blocks, block_cost : UInt32 [N]
        Blocks of each item and cost of one block, at least 1.
    ends : UInt64 [N]
        Prefix sums of the items' costs.
    sharing : Sharing
        Number of shares and lanes per team.
    """

    def __init__(self, blocks: Any, block_cost: Any, ends: Any, sharing: Sharing):
        self.count = dr.width(blocks)
        self.sharing, self.teams = sharing, sharing.teams
        self.arrays = self.blocks, self.block_cost, self.ends = blocks, block_cost, ends

    @classmethod
    def of(cls, blocks: Any, block_cost: Any, sharing: Sharing) -> Work:
        ends = dr.prefix_reduce(dr.ReduceOp.Add, mi.UInt64(blocks) * mi.UInt64(block_cost), exclusive=False)
        dr.eval(blocks, block_cost, ends)
        return cls(blocks, block_cost, ends, sharing)

    def shares(self, layout: Layout) -> Share:
        """The work of a kernel's lanes."""
        lanes = layout.lanes
        total = dr.gather(mi.UInt64, self.ends, dr.opaque(mi.UInt32, self.count - 1))
        lane = dr.arange(mi.UInt32, self.teams * lanes)
        share = total // self.teams + 1
        begin = mi.UInt64(lane // lanes) * share
        begin, end = (
            _cut(dr.minimum(x, total), total, self.ends, self.block_cost, dr.opaque(mi.UInt32, self.count))
            for x in (begin, begin + share)
        )
        return Share(lane, begin, end, self.blocks, layout, self.sharing.block)

    def add_up(self, kernel: Callable[..., Any], rows: int, width: int, parts: int = 1, /, **arguments: Any) -> Any:
        """Run kernel(share, target, **arguments), which adds to `rows` rows of `width` elements, padded to whole steps.

        Returns
        -------
        object
            The rows, Float [rows * width]. With `parts` > 1, the items are divided into that many parts or more. Each part is
            summed by itself, on a GPU many in one launch, and the partial sums are added in float64.
        """
        layout, Float64 = self.sharing.adding, dr.float64_array_t(mi.Float)
        size = rows * layout.packets(width)
        at_once = 1 if _on_cpu() else min(parts, MOST_PARTS, max(MOST_COPIED // size, 1))
        launches = -(-parts // at_once)
        if launches > 1:
            which = hashed(dr.arange(mi.UInt32, self.count)) % dr.opaque(mi.UInt32, launches)
            total: Any = 0
            for launch in range(launches):
                blocks = dr.select(which == dr.opaque(mi.UInt32, launch), self.blocks, 0)
                some = Work.of(blocks, self.block_cost, self.sharing)
                total += Float64(some.add_up(kernel, rows, width, at_once, **arguments))  # type: ignore[call-arg]
                dr.eval(total)
            return mi.Float(total)
        private = _on_cpu() and self.teams * size <= MOST_COPIED
        copies = self.teams if private else at_once
        values = dr.zeros(mi.Float, copies * size * layout.size)
        dr.make_opaque(values)
        share, stride = self.shares(layout), dr.opaque(mi.UInt32, size)
        team = share.lane // layout.lanes if private else None
        dr.eval(kernel(share, Target(values, stride, team, at_once), **arguments), values)
        if not private and copies > 1:
            values = _sum_of_copies(values, size * layout.size, copies)
        elif copies > 1:
            i, total = dr.arange(mi.UInt32, size), dr.zeros(mi.Vector4f, size)
            for copy in range(copies):
                total += dr.gather(mi.Vector4f, values, i + copy * stride)
            values = dr.empty(mi.Float, size * PACKET)
            dr.scatter(values, total, i, mode=dr.ReduceMode.Permute)
        return layout.crop(values, rows, width)


def _sum_of_copies(values, size, copies):
    """The sum of so many images of `size` elements, added in float64."""
    i, pitch = dr.arange(mi.UInt32, size), dr.opaque(mi.UInt32, size)
    Float64: Any = dr.float64_array_t(mi.Float)

    def add(copy, total):
        return (total + Float64(dr.gather(mi.Float, values, i + copy * pitch)),)

    return mi.Float(repeat(mi.UInt32(0), dr.opaque(mi.UInt32, copies), add, dr.zeros(Float64, size))[0])


def _cut(position, total, ends, block_cost, count):
    """The first block that begins at or after a position in the total cost, as (item, block).

    The end of all work is behind the last block: the last team need not walk through the empty items that may follow.
    """

    def halve(g, size):
        half = size // 2
        end = dr.gather(mi.UInt64, ends, g + half)
        behind = (end <= position) & (end < total)
        return dr.select(behind, g + half + 1, g), dr.select(behind, size - half - 1, half)

    g, _ = while_loop((mi.UInt32(0), mi.UInt32(count)), lambda g, size: size > 0, halve)
    start = dr.gather(mi.UInt64, ends, g - 1, g > 0)
    # A masked lane reads 0, and an integer division by 0 would crash.
    cost = dr.maximum(mi.UInt64(dr.gather(mi.UInt32, block_cost, g, g < count)), 1)
    return g, mi.UInt32((position - start + cost - 1) // cost)


def repeat(first: Any, last: Any, body: Callable[..., Any], *state: Any, by: int = 1) -> tuple:
    """`for i in range(first, last, by): state = body(i, *state)` in a kernel. Returns the last state."""

    def turn(i, *state):
        return i + by, *(body(i, *state) or ())

    return while_loop((first, *state), lambda i, *state: i < last, turn)[1:]


def pack(Packet: Any, Element: Any, columns: Sequence) -> Any:
    """Interleave columns [N] into rows of whole packets, so that a lane needs few loads."""
    count, packets = dr.width(columns[0]), len(columns) // PACKET
    target = dr.empty(Element, count * packets * PACKET)
    i = dr.arange(mi.UInt32, count)
    for j in range(packets):
        dr.scatter(target, Packet(*columns[PACKET * j : PACKET * (j + 1)]), i * packets + j, mode=dr.ReduceMode.Permute)
    return target


def load(packed: Any, index: Any, packets: int = 3) -> list[Any]:
    """Row `index` of an array made by `pack`."""
    return [x for j in range(packets) for x in dr.gather(mi.Vector4f, packed, index * packets + j)]


FAR = 3e8  # keeps whole numbers of elements, and sums of a few, within Int32; the fraction takes the excess


def whole(x: Any) -> Any:
    """The whole number nearest to x, for Float and Float64."""
    return dr.clip(dr.round(x), -FAR, FAR)


def high_low(x: Any) -> tuple[Any, Any]:
    """A Float64 as the sum of two Floats."""
    high = mi.Float(x)
    return high, mi.Float(x - type(x)(high))


def times(high: Any, low: Any, n: Any) -> tuple[Any, Any]:
    """The product of a `high_low` pair and a whole number, as a pair."""
    product = high * n
    return product, dr.fma(low, n, dr.fma(high, n, -product))


def pack_halves(a: Any, b: Any) -> Any:
    """Two corrections in one number, with eight binary digits each; `unpack_halves` is the inverse."""
    a, b = (_bits(x) & 0xFFFF0000 for x in (a, b))
    return dr.reinterpret_array(mi.Float, a | (b >> 16))


def unpack_halves(both: Any) -> tuple[Any, Any]:
    """The two corrections of `pack_halves`."""
    bits = _bits(both)
    return dr.reinterpret_array(mi.Float, bits & 0xFFFF0000), dr.reinterpret_array(mi.Float, bits << 16)


def _bits(x: Any) -> Any:
    """The bits of a Float, UInt32."""
    return dr.reinterpret_array(mi.UInt32, x)
