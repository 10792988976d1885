"""Views that were sorted by the names of their files as text, frame10 before frame2."""

from __future__ import annotations

import numpy as np

from lingo_mi.scan import Scan

# If the order of the numbers lowers the squared differences of neighbouring views by this factor, it is taken.
SMOOTHER = 0.7
BLOCKS = 32  # blocks of a view along either side: their means are compared


def text_order(scan: Scan) -> np.ndarray | None:
    """The place of every view in the order of its number, int [view], if the views were sorted as text; None if they were not.

    Views that are neighbours in angle are alike. They are compared as given, and in the order of the numbers, which may begin
    with 0 or 1.

    Examples
    --------
    >>> text_order(scan) is None
    True
    """
    n = len(scan)
    if n < 12:  # below, both orders are nearly the same
        return None
    blocks = _blocks(scan.projections)
    by_angle = np.argsort(scan.geometry.angles, kind='stable')
    best, roughness = None, _roughness(blocks[by_angle])
    least = SMOOTHER * roughness
    for first in (0, 1):
        place = np.array(sorted(range(first, first + n), key=str)) - first
        ordered = np.empty_like(blocks)
        ordered[place] = blocks
        if (rough := _roughness(ordered[by_angle])) < least:
            best, least = place, rough
    return best


def _blocks(p):
    rows, columns = (np.linspace(0, size, min(size, BLOCKS) + 1).astype(int)[:-1] for size in p.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(p, rows, 1, dtype=np.float64), columns, 2)
    return sums.reshape(len(p), -1)


def _roughness(views):
    return float(np.square(np.diff(views, axis=0)).mean())
