"""The update of SART, for a volume in memory (`sart`) and for one on a disk (`slab_sweeps`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.reconstruction.system import evaluated, scalar


def normalised(error: mi.Float, path: mi.Float) -> mi.Float:
    """W (b - A x): what images lack over the lengths of their rays (or their weighted lengths); 0 where there is no ray."""
    return evaluated(_over(error, path))


def updated(
    x: mi.Float, lmbda: float, noneg: bool, weights: mi.Float | None = None
) -> Callable[[Any, Any, Any], mi.Float]:
    """The rule for `Joseph.adjoint` that makes the next volume of x (mi.Float [voxels]): x + lmbda weights A^T y / A^T 1, or 0.

    noneg   whether negative densities are set to zero
    """
    step = scalar(lmbda)

    def rule(voxel, change, weight):
        change = _over(change, weight)
        if weights is not None:
            change *= dr.gather(mi.Float, weights, voxel)
        value = dr.fma(step, change, dr.gather(mi.Float, x, voxel))
        return dr.maximum(value, 0) if noneg else value

    return rule


def _over(value, weight):
    return dr.select(weight > 0, value * dr.rcp(dr.maximum(weight, 1e-30)), 0)
