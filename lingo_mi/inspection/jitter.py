"""Unsteadiness of the object's outline from view to view: third differences, in which smooth motion cancels."""

from __future__ import annotations

import numpy as np

LEVEL = 0.15  # part of the highest value at which the outline is taken
STEEPEST = np.radians(6)  # between views: beyond, an outline's own motion is not smooth


def outline_jitter(p: np.ndarray, angles: np.ndarray) -> tuple[float, float]:
    """Standard deviation in pixels of the outline's place, (along columns, along rows); nan if it cannot be determined.

    The place along a row is the mean of the object's left and right edge. The place along a column is the mean of its upper and
    lower edge. For independent errors of deviation s the third differences of neighbouring views have the deviation s sqrt(20).
    Their median ignores single views. The object's own corners add 0.02 to 0.1 pixels, which stay in.

    Parameters
    ----------
    p : ndarray
        [view, v, u] line integrals, air subtracted.
    angles : ndarray
        [view] radians, in the order of the views.
    """
    step = np.abs(np.diff(np.unwrap(angles)))
    if len(p) < 12 or step.max(initial=0) > STEEPEST or np.ptp(step) > 0.1 * step.max():
        return np.nan, np.nan
    return _jitter(p.mean(2)), _jitter(p.mean(1))


def _jitter(profiles):
    """Return the unsteadiness of profiles [view, pixel] through the object, with air at both ends."""
    level = LEVEL * profiles.max()
    inside = profiles > level
    if inside[:, [0, -1]].any() or not inside.any(1).all():
        return np.nan
    n, view = profiles.shape[1], np.arange(len(profiles))

    def crossing(first, second):  # between a pixel of air and the object's outermost
        a, b = profiles[view, first], profiles[view, second]
        return first + (second - first) * (level - a) / (b - a)

    left, right = inside.argmax(1), n - 1 - inside[:, ::-1].argmax(1)
    middle = (crossing(left - 1, left) + crossing(right + 1, right)) / 2
    return float(1.4826 * np.median(np.abs(np.diff(middle, 3))) / np.sqrt(20))
