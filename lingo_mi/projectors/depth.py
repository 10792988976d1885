"""How many items lie on top of each other, and in how many parts their sum must be taken.

An element of an image that n equal numbers are added to one by one in float32 is off by some n 2e-9 of itself. Where more
than DEEP items lie at one place, they are therefore added up in parts, each into a sum of its own, and the sums in float64.
Items that overlap from different places add different numbers, of which the rounding cancels: RANDOM times as many do no more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

DEEP = 1_000  # 2e-6
RANDOM = 32
CELLS = {2: (256, 64, 8), 3: (32, 16, 4)}  # by the number of axes, along each of them: of one element, and of two sizes
SAMPLE = 16384  # items that are looked at


def hashed(i: Any) -> Any:
    """Numbers that follow in no order from those that do, UInt32 (Knuth's multiplicative hash): clouds may be periodic."""
    return i * 2654435761 // 65536


def parts_of(depth: Any) -> int:
    """In how many parts to add up items that lie so `deepest`. Waits for the device."""
    return max(-(-int(depth[0]) // DEEP), 1)


def deepest(places: Sequence, covered: Any, shape: Sequence[int]) -> Any:
    """How many items lie on top of each other where they do most, on a grid of elements: Float [1], 0 where few are there.

    places    Int32 [N] for each axis, an item's element; it may lie outside the grid
    covered   Float [N], elements that an item covers
    shape     elements along each axis

    Covered elements are counted by the cell in which the items' centres lie: cells of one element, of which those a number of
    cells apart count as one; cells of some share of the grid, and larger ones; and the whole grid. Of many items a sample is
    counted.
    """
    count = dr.width(covered)
    if count <= DEEP:
        return mi.Float(0)
    single, *sides = CELLS[len(shape)]
    levels = [(single, None), *((side, [max(n / side, 1.0) for n in shape]) for side in sides)]
    with dr.suspend_grad():
        step = count // SAMPLE + 1
        i, every = dr.arange(mi.UInt32, count // step), dr.opaque(mi.UInt32, step)
        i = i * every + hashed(i) % every
        covered = dr.gather(mi.Float, covered, i)
        inside = [dr.clip(dr.gather(mi.Int32, p, i), 0, n - 1) for p, n in zip(places, shape)]
        depth = dr.zeros(mi.Float, sum(cells ** len(shape) for cells, _ in levels) + 1)
        first = 0
        for cells, size in levels:
            index, volume = mi.UInt32(0), 1.0
            for axis, p in enumerate(inside):
                along = mi.UInt32(p) % cells if size is None else mi.UInt32(mi.Float(p) / size[axis])
                index, volume = index * cells + along, volume * (1.0 if size is None else size[axis])
            dr.scatter_add(depth, dr.minimum(covered / volume, 1) / (1 if size is None else RANDOM), index + first)
            first += cells ** len(shape)
        dr.scatter_add(depth, covered / (RANDOM * math.prod(shape)), mi.UInt32(first))
        return step * dr.max(depth)
