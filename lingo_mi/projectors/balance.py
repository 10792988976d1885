"""Load balancing of uneven work: a fixed number of teams, each with the same share of the total cost.

An *item* (a Gaussian, a triangle) consists of *blocks* of rows. All blocks of an item have the same cost, and a prefix sum
gives the end of each item's cost. A *team* has as many lanes as a block has rows; it works on one item at a time, one lane per
row. Each team takes the blocks that begin within its share of the total cost. So all teams share a huge item, an empty
item costs nothing, and launch size and kernel never change.

On the CPU, each team adds to its own image without atomics (which would take most of the time), and the copies are summed at
the end, unless they would be too large. On the GPU there are many teams, one image and atomic additions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.depth import hashed

while_loop: Any = dr.while_loop  # as it is declared, a loop has one variable

PACKET = 4  # consecutive elements that a lane reads or writes at once
MOST_COPIED = 1 << 25  # packets in all copies of a target (512 MB); a larger one is shared, with atomics


@dataclass(frozen=True)
class Sharing:
    """The number of shares, and the width of the teams that do one share each. Images do not depend on it, but for rounding.

    lanes               lanes of a team, which is the number of rows of a block
    shares_per_thread   shares per CPU thread; more shares balance better, but each has its own image
    shares_on_gpu       shares on a GPU
    """

    lanes: int = 8
    shares_per_thread: float = 2
    shares_on_gpu: int = 4096

    def scaled(self, factor: float) -> Sharing:
        """`factor` times as many shares."""
        return replace(
            self,
            shares_per_thread=factor * self.shares_per_thread,
            shares_on_gpu=max(round(factor * self.shares_on_gpu), 1),
        )


SHARING = Sharing()  # as measured: docs/accuracy.md


@dataclass
class Share:
    """The work of a kernel's lanes.

    lane         UInt32, lane numbers; those of a team are consecutive
    begin, end   of the team's share, as (item, block), UInt32
    blocks       UInt32 [N], blocks of each item
    lanes        lanes per team
    """

    lane: Any
    begin: tuple
    end: tuple
    blocks: Any
    lanes: int

    def row(self, block: Any) -> Any:
        """The row of an item that a lane works on, in one of its blocks, Int32."""
        return mi.Int32(block * self.lanes + self.lane % self.lanes)

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

    values    Float, the images of all teams, or one common image
    base      Int32, the first packet of a team's own image
    private   whether each team has its own image, and needs no atomics
    """

    values: Any
    base: Any
    private: bool

    def add(self, value: Any, index: Any) -> None:
        """Add a packet, Vector4f. index: counts packets from the start of `values`."""
        mode = dr.ReduceMode.NoConflicts if self.private else dr.ReduceMode.Auto
        dr.scatter_add(self.values, value, index, mode=mode)


class Work:
    """Items shared out among teams, from evaluated arrays:

    blocks, block_cost   UInt32 [N], blocks of each item and cost of one block, at least 1
    ends                 UInt64 [N], prefix sums of the items' costs
    sharing              number of shares and lanes per team
    """

    def __init__(self, blocks: Any, block_cost: Any, ends: Any, sharing: Sharing):
        self.count = dr.width(blocks)
        self.on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
        self.sharing = sharing
        per_cpu = max(round(sharing.shares_per_thread * dr.thread_count()), 1)
        self.teams = per_cpu if self.on_cpu else sharing.shares_on_gpu
        self.arrays = self.blocks, self.block_cost, self.ends = blocks, block_cost, ends

    @classmethod
    def of(cls, blocks: Any, block_cost: Any, sharing: Sharing) -> Work:
        ends = dr.prefix_reduce(dr.ReduceOp.Add, mi.UInt64(blocks) * mi.UInt64(block_cost), exclusive=False)
        dr.eval(blocks, block_cost, ends)
        return cls(blocks, block_cost, ends, sharing)

    def shares(self) -> Share:
        """The work of a kernel's lanes."""
        lanes = self.sharing.lanes
        total = dr.gather(mi.UInt64, self.ends, dr.opaque(mi.UInt32, self.count - 1))
        lane = dr.arange(mi.UInt32, self.teams * lanes)
        share = total // self.teams + 1
        begin = mi.UInt64(lane // lanes) * share
        begin, end = (
            _cut(dr.minimum(x, total), self.ends, self.block_cost, dr.opaque(mi.UInt32, self.count))
            for x in (begin, begin + share)
        )
        return Share(lane, begin, end, self.blocks, lanes)

    def add_up(self, kernel: Callable[..., Any], rows: int, width: int, parts: int = 1, /, **arguments: Any) -> Any:
        """Run kernel(share, target, **arguments), which adds to `rows` rows of `width` elements, padded to whole packets.

        Returns the rows, Float [rows * width]. With `parts` > 1, the items are divided into that many parts. Each part is
        summed by itself, and the partial sums are added in float64.
        """
        if parts > 1:
            which = hashed(dr.arange(mi.UInt32, self.count)) % dr.opaque(mi.UInt32, parts)
            total: Any = 0
            Float64: Any = dr.float64_array_t(mi.Float)
            for part in range(parts):
                blocks = dr.select(which == dr.opaque(mi.UInt32, part), self.blocks, 0)
                some = Work.of(blocks, self.block_cost, self.sharing)
                total += Float64(some.add_up(kernel, rows, width, **arguments))
                dr.eval(total)
            return mi.Float(total)
        size = rows * packets_of(width)
        private = self.on_cpu and self.teams * size <= MOST_COPIED
        copies = self.teams if private else 1
        values = dr.zeros(mi.Float, copies * size * PACKET)
        dr.make_opaque(values)
        share, stride = self.shares(), dr.opaque(mi.UInt32, size)
        base = mi.Int32(share.lane // share.lanes * stride if private else mi.UInt32(0))
        dr.eval(kernel(share, Target(values, base, private), **arguments), values)
        if copies > 1:
            i, total = dr.arange(mi.UInt32, size), dr.zeros(mi.Vector4f, size)
            for copy in range(copies):
                total += dr.gather(mi.Vector4f, values, i + copy * stride)
            values = dr.empty(mi.Float, size * PACKET)
            dr.scatter(values, total, i, mode=dr.ReduceMode.Permute)
        return crop(values, rows, width)


def _cut(position, ends, block_cost, count):
    """The first block that begins at or after a position in the total cost, as (item, block)."""

    def halve(g, size):
        half = size // 2
        behind = dr.gather(mi.UInt64, ends, g + half) <= position
        return dr.select(behind, g + half + 1, g), dr.select(behind, size - half - 1, half)

    g, _ = while_loop((mi.UInt32(0), mi.UInt32(count)), lambda g, size: size > 0, halve)
    start = dr.gather(mi.UInt64, ends, g - 1, g > 0)
    # A masked lane reads 0, and an integer division by 0 would crash.
    cost = dr.maximum(mi.UInt64(dr.gather(mi.UInt32, block_cost, g, g < count)), 1)
    return g, mi.UInt32((position - start + cost - 1) // cost)


def repeat(first: Any, last: Any, body: Callable[..., Any], *state: Any) -> tuple:
    """`for i in range(first, last): state = body(i, *state)` in a kernel. Returns the last state."""
    return while_loop((first, *state), lambda i, *state: i < last, lambda i, *state: (i + 1, *(body(i, *state) or ())))[
        1:
    ]


def packets_of(width: int) -> int:
    """Packets of a row of `width` elements."""
    return -(-width // PACKET)


def pad(image: Any, rows: int, width: int) -> Any:
    """Float [rows * width] with zeros at the end of each row, up to whole packets."""
    if width % PACKET == 0:
        return image
    padded = packets_of(width) * PACKET
    i = dr.arange(mi.UInt32, rows * padded)
    pitch, columns = dr.opaque(mi.UInt32, padded), dr.opaque(mi.UInt32, width)
    row, column = i // pitch, i % pitch
    return dr.gather(mi.Float, image, row * columns + column, column < columns)


def crop(padded: Any, rows: int, width: int) -> Any:
    """The inverse of `pad`."""
    if width % PACKET == 0:
        return padded
    i, columns, pitch = dr.arange(mi.UInt32, rows * width), dr.opaque(mi.UInt32, width), packets_of(width) * PACKET
    return dr.gather(mi.Float, padded, i // columns * dr.opaque(mi.UInt32, pitch) + i % columns)


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


def span(low: Any, high: Any, offset: Any, column: Any, empty: Any, packets: Any) -> tuple[Any, Any]:
    """The packets [begin, end) of a row that cover t in [low, high], where t = 0 is at the element column + offset."""
    far = 1e8  # keeps distant positions within Int32
    first = mi.Int32(dr.clip(dr.ceil(low + offset), -far, far)) + column
    last = mi.Int32(dr.clip(dr.floor(high + offset), -far, far)) + column
    begin = dr.maximum(first, 0) // PACKET
    empty |= (last < first) | (last < 0)
    return begin, dr.select(empty, begin, dr.minimum(last // PACKET + 1, packets))


def position(packet: Any, column: Any, offset: Any) -> Any:
    """t of the elements of a packet, with full precision near t = 0."""
    whole = mi.Float(packet * PACKET - column)
    return mi.Vector4f(whole - offset, (whole + 1) - offset, (whole + 2) - offset, (whole + 3) - offset)
