"""Numbers of overlapping items, and of the partial sums that they need.

Adding n equal numbers one by one in float32 leaves a relative error of about n 8e-9; of n 2e-9 on the CPU, where the teams'
images share them. If more than `deep` items lie at one place, they are therefore added into several partial sums, and these are
added in float64. Items at different places that overlap add different numbers, and their rounding errors cancel: RANDOM times as
many cause no larger error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

RANDOM = 32
CELLS = {2: (256, 64, 8), 3: (32, 16, 4)}  # by number of axes: cells per axis at the first three levels
SAMPLE = 16384  # items counted at most


def hashed(i: Any) -> Any:
    """Knuth's multiplicative hash, UInt32: an irregular sample, because clouds may be periodic."""
    return i * 2654435761 // 65536


def deep() -> int:
    """The items at one place that one sum may hold, for an error of 2e-6."""
    return 1_000 if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else 250


def parts_of(depth: Any) -> int:
    """Number of partial sums for a depth that `deepest` returned. Waits for the device."""
    return max(-(-int(depth[0]) // deep()), 1)


def deepest(places: Sequence, covered: Any, shape: Sequence[int]) -> Any:
    """The largest number of items that overlap in one element of a grid: Float [1], 0 for few items.

    Counts covered elements per cell (the cell of an item's centre) at four levels: single elements, with wrapped indices; two
    coarser grids; and the whole grid. Large clouds are sampled.

    Parameters
    ----------
    places : Sequence
        Int32 [N] for each axis, an item's element; it may lie outside the grid.
    covered : Float [N]
        Elements that an item covers.
    shape : Sequence[int]
        Elements along each axis.
    """
    count = dr.width(covered)
    if count <= deep():
        return mi.Float(0)
    single, *sides = CELLS[len(shape)]
    levels = [(single, None), *((side, [max(n / side, 1.0) for n in shape]) for side in sides)]
    with dr.suspend_grad():
        step = count // SAMPLE + 1
        i, every = dr.arange(mi.UInt32, count // step), dr.opaque(mi.UInt32, step)
        i = i * every + hashed(i) % every
        covered = dr.gather(mi.Float, covered, i)
        # Values that are not finite make the result NaN, but must not make the number of parts NaN.
        covered = dr.select(dr.isfinite(covered), covered, 0)
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
