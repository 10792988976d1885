"""Columns of the panel that show the same in all views, while those on either side do not."""

from __future__ import annotations

import numpy as np

from lingo_mi.scan import Scan

STILL = 0.1  # part of the neighbours' change from view to view: a dead column changes less
REACH = 4  # columns to either side: a dead stripe may be so wide


def dead_columns(scan: Scan) -> list[int]:
    """The dead columns, those left out of a scan entirely not among them.

    Examples
    --------
    >>> dead_columns(scan)
    []
    """
    p, valid = scan.projections, scan.valid
    if len(p) < 3:
        return []
    change = np.square(np.diff(p, axis=0), dtype=np.float64)
    if valid is not None:
        both = valid[1:] & valid[:-1]
        change[~both] = 0
        count = both.sum((0, 1))
    else:
        count = np.full(p.shape[2], len(change) * p.shape[1])
    change = np.sqrt(change.sum((0, 1)) / np.maximum(count, 1))

    def livelier(u, part):
        return change[part].max(initial=0) > change[u] / STILL

    sides = ((u, slice(max(u - REACH, 0), u), slice(u + 1, u + 1 + REACH)) for u in range(len(change)))
    return [u for u, left, right in sides if count[u] and livelier(u, left) and livelier(u, right)]
