"""The amount of work for an image of a cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.projectors.footprint import project
from lingo_mi.projectors.view import View


def count_pairs(gaussians: Sequence, view: View, extent: float) -> float:
    """Pairs of a pixel and a Gaussian: pixels in the bounding boxes of all footprints, summed.

    Parameters
    ----------
    gaussians : Sequence
        Centre, scale, rotation and density as Dr.Jit arrays.
    extent : float
        Cut-off in standard deviations.
    """
    f: Any = project(gaussians, view, extent)
    Float64: Any = dr.float64_array_t(mi.Float)
    return float(dr.sum(Float64(mi.Float(f.row_end - f.row_begin) * f.width))[0])
