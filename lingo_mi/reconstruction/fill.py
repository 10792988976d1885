"""Pixels that are not valid, interpolated from valid ones: for algorithms that need every pixel.

Each is a mean of two linear interpolations, along its row and over the views, with weights of one over the distance between the
valid pixels on either side. Between neighbouring views, details move by up to the angle times half the panel's width, and that
counts as their distance. So dead pixels and edges of metal are filled along the row (Kalender, Hebel, Ebersberger, "Reduction of
CT artifacts caused by metallic implants", Radiology 164, 1987), and pixels that few views lack, from these views' neighbours.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from scipy import ndimage

from lingo_mi.scan import Scan

NOWHERE = np.inf  # distance to valid pixels if there are none


def filled(scan: Scan) -> Scan:
    """The scan with every pixel, and a warning that says how many were filled; a scan of valid pixels alone as it is.

    Examples
    --------
    >>> filled(replace(scan, valid=scan.projections < 5)).valid is None
    True
    """
    if scan.valid is None:
        return scan
    valid, p = scan.valid, scan.projections.copy()
    step = np.median(np.abs(np.diff(np.unwrap(scan.geometry.angles)))) if len(scan) > 1 else 0.0
    moves = max(1.0, float(step) * p.shape[2] / 2)  # pixels from view to view
    alone = np.zeros(p.shape, bool)
    for row in np.flatnonzero(~valid.all((0, 2))):
        values, valid_row = p[:, row], valid[:, row]
        along, apart = _between(values, valid_row)
        over, views_apart = (x.T for x in _between(values.T, valid_row.T))
        a, b = 1 / apart, 1 / (moves * views_apart)
        alone[:, row] = ~valid_row & (a + b == 0)
        p[:, row] = np.where(valid_row, values, (a * along + b * over) / np.maximum(a + b, 1e-12))
    if alone.any():  # no valid pixel in the row, nor in other views: take the nearest
        nearest = np.asarray(ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True))
        p[alone] = scan.projections[tuple(nearest)][alone]
    count = int((~valid).sum())
    warnings.warn(
        f'{count} {"pixel" if count == 1 else "pixels"} ({count / valid.size:.2g} of all) that are not valid were filled from '
        'their neighbours; fill=false refuses such a scan',
        stacklevel=2,
    )
    return replace(scan, projections=p, valid=None)


def _between(values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear interpolation along the last axis, and the distance between the known values on either side; beyond the last, its
    value, and twice the distance from it."""
    n = values.shape[-1]
    at = np.broadcast_to(np.arange(n), values.shape)
    before = np.maximum.accumulate(np.where(valid, at, -1), -1)
    after = np.minimum.accumulate(np.where(valid, at, n)[..., ::-1], -1)[..., ::-1]
    first, last = (np.take_along_axis(values, np.clip(x, 0, n - 1), -1) for x in (before, after))
    left, right = before >= 0, after < n
    apart = np.maximum(after - before, 1)
    share = (at - before) / apart
    value = np.where(left & right, first + share * (last - first), np.where(left, first, last))
    one_sided = 2 * np.where(left, at - before, after - at)
    return value, np.where(left & right, apart, np.where(left | right, np.maximum(one_sided, 1), NOWHERE)).astype(float)
