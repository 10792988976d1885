"""High and low masks of every projection (paper, section III-A). Pure NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lingo_mi.lingo.otsu import otsu


@dataclass(frozen=True)
class Masks:
    """Masks of n projections and their thresholds.

    low, high     bool [n, v, u]; high is a subset of low if the thresholds are positive
    t_low, t_high float64 [n], in units of the projections
    valid         bool [n, v, u], valid pixels; None: all
    """

    low: np.ndarray
    high: np.ndarray
    t_low: np.ndarray
    t_high: np.ndarray
    valid: np.ndarray | None = None


def masks(projections: np.ndarray, low_factor: float = 0.1, valid: np.ndarray | None = None) -> Masks:
    """M_h = I > T_h with T_h = Otsu(I), and M_l = I > T_l with T_l = `low_factor` T_h, per view.

    Parameters
    ----------
    projections : ndarray
        [n, v, u] line integrals (the object is bright).
    valid : ndarray or None
        Bool [n, v, u]; invalid pixels affect no threshold and are in no mask. None: all are valid.
    """
    projections = np.asarray(projections)
    valid_views = [...] * len(projections) if valid is None else valid
    t_high = np.array([otsu(image[v]) if v is ... or v.any() else 0.0 for image, v in zip(projections, valid_views)])
    t_low = t_high * low_factor
    at = (slice(None), None, None)
    low, high = projections > t_low[at], projections > t_high[at]
    if valid is not None:
        low, high = low & valid, high & valid
    return Masks(low, high, t_low, t_high, valid)


def truncated(masks: Masks, share: float = 0.05) -> np.ndarray:
    """Views, bool [n], in which the object reaches the edge of the panel: the low mask contains more than `share` of the
    outermost pixels of a side.

    An axis of one pixel (a fan beam's rows) is not checked.
    """
    low = masks.low
    sides = [side for axis in (2, 1) if low.shape[axis] > 1 for side in _sides(low, masks.valid, axis, share)]
    return np.any(sides, 0) if sides else np.zeros(len(low), bool)


def _sides(low, valid, axis, share):
    """For the first and the last valid pixels along an axis: views, bool [n], with more than `share` of them in the mask."""
    if valid is None:
        return [low.take(end, axis).mean(1) > share for end in (0, -1)]
    lines, last = valid.any(axis), low.shape[axis] - 1
    ends = valid.argmax(axis), last - np.flip(valid, axis).argmax(axis)
    sides = (np.take_along_axis(low, np.expand_dims(end, axis), axis).squeeze(axis) for end in ends)
    return [(side & lines).sum(1) > share * np.maximum(lines.sum(1), 1) for side in sides]
