"""High and low masks of every projection (paper, section III-A). Pure NumPy."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .otsu import otsu


@dataclass(frozen=True)
class Masks:
    """Masks of n projections and what they were cut at.

    low, high     bool [n, v, u]; high is part of low wherever the thresholds are positive
    t_low, t_high float64 [n], in units of the projections
    """

    low: np.ndarray
    high: np.ndarray
    t_low: np.ndarray
    t_high: np.ndarray


def masks(projections, low_factor: float = 0.1) -> Masks:
    """M_h = I > T_h with T_h = Otsu(I), and M_l = I > T_l with T_l = `low_factor` T_h, per view.

    projections  [n, v, u] line integrals (the object is bright)
    """
    projections = np.asarray(projections)
    t_high = np.array([otsu(image) for image in projections])
    t_low = t_high * low_factor
    at = (slice(None), None, None)
    return Masks(projections > t_low[at], projections > t_high[at], t_low, t_high)
