"""Angular gaps between the views of a scan."""

from __future__ import annotations

import numpy as np

MISSING = np.radians(20)  # beyond a typical gap


def gaps(angles: np.ndarray, turn: float) -> tuple[np.ndarray, np.ndarray, bool]:
    """The order of the views around the circle, the gap after each in that order, and whether the arc is open.

    Angles are taken modulo `turn`, radians. An open arc begins with the first view; the views at its ends represent a typical
    gap. It lacks `MISSING` or more; a circle that lacks a view or two is closed.
    """
    angle = np.mod(angles, turn)
    order = np.argsort(angle, kind='stable')
    gap = np.diff(angle[order], append=angle[order[0]] + turn)
    distinct = np.sort(gap[gap > 1e-6])
    typical = np.median(distinct[:-1]) if len(distinct) > 1 else distinct[-1]
    is_open = bool(distinct[-1] > max(2.5 * typical, typical + MISSING))
    if is_open:
        widest = np.argmax(gap)
        gap[widest] = typical
        order, gap = np.roll(order, -widest - 1), np.roll(gap, -widest - 1)
    return order, gap, is_open
