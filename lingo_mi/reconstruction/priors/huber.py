"""Huber's penalty on the differences between voxels (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from lingo_mi.reconstruction.priors.differences import LARGEST, differences, length, transposed
from lingo_mi.reconstruction.priors.prior import Prior, check_positive


@dataclass
class Huber(Prior):
    """Huber's function of the lengths of the differences between neighbouring voxels: quadratic up to `delta`, linear above.

    It smooths noise and preserves edges, and does not turn slopes into steps, as total variation does. R has a gradient.

    Parameters
    ----------
    delta : float
        Length up to which a difference counts as noise, 1/mm, above 0. A smaller delta needs more iterations.

    Raises
    ------
    InputError
        For a delta out of its range.

    References
    ----------
    Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35 (1964); for tomography Stevenson and Delp, "Fitting
    curves with discontinuities", 1990.

    Examples
    --------
    >>> Huber(delta=1e-3).curvature
    12000.0
    """

    delta: float

    def __post_init__(self):
        check_positive('delta', self.delta)
        self.curvature = LARGEST / self.delta

    def gradient(self, x, size):
        d = differences(x, size)
        shorter = dr.rcp(dr.maximum(length(d), dr.opaque(mi.Float, self.delta)))
        p = [c * shorter for c in d]
        dr.eval(p)
        out = transposed(p, size)
        dr.eval(out)
        return out
