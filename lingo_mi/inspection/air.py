"""The air level of every view, read beside the object: what a beam that drifts or tilts adds to the line integrals.

The level of a view is a plane over the panel, fitted to the pixels at its left and right edge. TomoPy's `normalize_bg` likewise
draws a line between both edges of a row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from lingo_mi.scan import Scan

STRIP = 32  # a strip at an edge is the panel's width over this, and two pixels at least
NEAR = 0.1  # part of the highest line integral: air is so near to the lowest at the edges
ALL = 0.95  # least part of a strip's pixels that are air, in all views together
LOW = 0.2  # part of the highest line integral: air is not higher
BLOCKS, ROWS = 8, 8  # medians along a strip; rows that a slope along the columns needs
FLAT = 0.01  # part of the highest line integral, rms: air is a plane, and the edge of an object is not
DEGREE, SURE = 3, 3.0  # degree of polynomials in time; standard errors from which they are a drift
LEAST = 1e-3  # part of the highest line integral: smaller levels do no harm


@dataclass(frozen=True)
class Air:
    """The air level of the views of a scan.

    Attributes
    ----------
    levels : ndarray of shape (n, 3)
        Line integral at the panel's centre, and what it rises by from there to the panel's lower and right edge.
    drift : float
        Standard deviation of the first of these over the views.
    matters : bool
        Whether the level, or a slope, is further from 0 than its noise and than what does no harm.
    """

    levels: np.ndarray
    drift: float
    matters: bool

    def image(self, shape: tuple[int, int]) -> np.ndarray:
        """The level in every pixel of a panel, float32 [view, v, u]."""
        y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in shape)
        constant, down, right = self.levels.T[:, :, None, None]
        return (constant + down * y[:, None] + right * x).astype(np.float32)


def air_of(scan: Scan) -> Air | None:
    """The air level of the views, or None if no edge of the panel shows air in all of them.

    Examples
    --------
    >>> air_of(scan).levels[:, 0]
    """
    p = scan.projections
    n, nv, nu = p.shape
    valid = np.ones(p.shape, bool) if scan.valid is None else scan.valid
    high, width = float(np.percentile(p[valid], 99.5)), max(2, nu // STRIP)
    if high <= 0 or nu < 4 * width:
        return None
    strips = [(np.where(valid[:, :, part], p[:, :, part], np.nan), x) for part, x in _edges(nu, width)]
    strips = [(strip, x) for strip, x in strips if np.isfinite(strip).any((1, 2)).all()]
    if not strips:
        return None
    low = np.min([np.nanpercentile(strip, 5, (1, 2)) for strip, _ in strips], 0)[:, None, None]  # of each view
    typical = float(np.median(low))
    near = low + NEAR * (high - typical)
    strips = [(strip, x) for strip, x in strips if np.mean((strip <= near)[np.isfinite(strip)]) > ALL]
    if not strips or typical > LOW * high:
        return None
    values, rows = [], np.array_split(np.arange(nv), min(BLOCKS, nv))
    columns = []
    for strip, x in strips:
        for part in rows:
            block = strip[:, part].reshape(n, -1)
            if np.isfinite(block).any(1).all():
                values.append(np.nanmedian(block, 1))
                columns.append((1.0, (part.mean() + 0.5) / nv * 2 - 1, x))
    if not values:
        return None
    measured, places = np.array(values).T, np.array(columns)
    determined = [True, nv >= ROWS and len(values) >= ROWS, len(set(places[:, 2])) > 1]
    levels = np.zeros((n, 3))
    levels[:, determined] = np.linalg.lstsq(places[:, determined], measured.T, rcond=None)[0].T
    if np.sqrt(np.square(measured - levels @ places.T).mean()) > FLAT * high:
        return None
    return Air(levels, float(levels[:, 0].std()), _matters(levels, high))


def without_air(scan: Scan) -> Scan:
    """The scan without its air level, if that can be read."""
    air = air_of(scan)
    return scan if air is None else replace(scan, projections=scan.projections - air.image(scan.geometry.nDetector))


def steady(scan: Scan) -> tuple[Scan, Air | None]:
    """The scan without its air level, if that matters, and the level that was taken out."""
    air = air_of(scan)
    if air is None or not air.matters:
        return scan, None
    return without_air(scan), air


def _edges(nu, width):
    """The strips at the left and right edge, and the places of their middles, -1 to 1 over the panel."""
    middle = 1 - width / nu
    return (slice(0, width), -middle), (slice(nu - width, nu), middle)


def _matters(levels, high):
    """Return whether a polynomial in time through a level stands out of the noise, which second differences measure."""
    n = len(levels)
    if n < DEGREE + 3:
        return False
    basis = legendre.legvander(np.linspace(-1, 1, n), DEGREE)
    smooth = basis @ np.linalg.lstsq(basis, levels, rcond=None)[0]
    noise = np.sqrt(np.square(np.diff(levels, 2, axis=0)).mean(0) / 6)
    size = np.sqrt(np.square(smooth).mean(0))
    return bool(((size > SURE * noise * np.sqrt((DEGREE + 1) / n)) & (size > LEAST * high)).any())
