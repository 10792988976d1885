"""The update of SART, for a volume in memory (`sart`) and for one on a disk (`slab_sweeps`).

With Joseph's projector an update in memory is recorded once and replayed. To trace it takes five milliseconds of Python, longer
than the kernels of a small scan, or of a large one on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.common.runtime import drjit_lock
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.projectors.replay import Replay
from lingo_mi.projectors.stack import Block, Views
from lingo_mi.reconstruction.system import System, evaluated, scalar


def update(system: System, x: mi.Float, views: Views, lmbda: float, noneg: bool) -> mi.Float:
    """The next volume of x (mi.Float [voxels], density per mm) by a block of views."""
    A, step = system.A, scalar(lmbda)
    volumes = x, system.b, system.weights, system.weighed
    if isinstance(A, GridPair):
        return _update(A, views, step, noneg, *volumes)
    block = Block.of(views)
    with drjit_lock():
        return _REPLAY(
            block.numbers, block.count, step, *volumes, *A.arrays, kind=type(A), settings=A.settings, noneg=noneg
        )


def _update(A, views, step, noneg, x, b, weights, weighed):
    ax, path = A.forward(x, views)
    if weights is not None:
        path = A.select(weighed, views)
    error = normalised(A.select(b, views) - ax, path)
    return evaluated(A.adjoint(error, views, updated(x, step, noneg, weights)))


def _replayed(numbers, count, step, x, b, weights, weighed, *arrays, kind, settings, noneg):
    return _update(kind.of(arrays, settings), Block(numbers, count), step, noneg, x, b, weights, weighed)


_REPLAY = Replay(_replayed)


def normalised(error: mi.Float, path: mi.Float) -> mi.Float:
    """W (b - A x): what images lack over the lengths of their rays (or their weighted lengths); 0 if there is no ray."""
    return evaluated(_over(error, path))


def updated(
    x: mi.Float, step: mi.Float, noneg: bool, weights: mi.Float | None = None
) -> Callable[[Any, Any, Any], mi.Float]:
    """The rule for `Joseph.adjoint` that makes the next volume of x (mi.Float [voxels]): x + step weights A^T y / A^T 1, or 0.

    Parameters
    ----------
    noneg : bool
        Whether negative densities are set to zero.
    """

    def rule(voxel, change, weight):
        change = _over(change, weight)
        if weights is not None:
            change *= dr.gather(mi.Float, weights, voxel)
        value = dr.fma(step, change, dr.gather(mi.Float, x, voxel))
        return dr.maximum(value, 0) if noneg else value

    return rule


def _over(value, weight):
    return dr.select(weight > 0, value * dr.rcp(dr.maximum(weight, 1e-30)), 0)
