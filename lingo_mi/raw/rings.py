"""Rings: errors of single pixels that are the same in all views, such as gains that have changed since the flat fields.

A gain of 1 + g adds -ln(1 + g) to a pixel's line integrals in every view, and a reconstruction turns that into a ring or an arc.
The object's own details move from view to view. So the offset of a pixel is the median over the views of its difference to a
smooth curve along its row (after Boin and Haibel, Opt. Express 14, 2006, who compare the mean over the views with a smooth curve:
edges that stand still for some views shift a mean, and hardly a median). It is the curve of Savitzky and Golay (Anal. Chem. 36,
1964), of degree 4, because a flatter one takes the curvature of the object for an offset.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import savgol_filter

from lingo_mi.common.errors import InputError

WINDOW, DEGREE = 21, 4  # columns of the curve, and its degree
PASSES = 3  # each finds part of the offsets that neighbours hid from the last
MOST_PIXELS = 2**26  # of all views, in memory at a time: 256 MB
LEAST_VIEWS = 25  # fewer leave so much of the object in the median that a sound chest changes by more than its noise
LEAST_COLUMNS = 256  # on fewer, a body's details are as narrow as the curve: a chest on 192 columns loses 0.8 dB


def ring_offsets(projections: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Return the value that each pixel adds to its line integrals in all views, float32 [v, u]. It is to be subtracted.

    Parameters
    ----------
    projections : ndarray or zarr.Array
        Line integrals [view, v, u]; of an array in a file, a block of rows at a time is in memory.
    valid : ndarray or None
        Bool, likewise; None: all. A pixel that is not valid in half of the views gets no offset.

    Raises
    ------
    InputError
        For fewer than `LEAST_VIEWS` views or `LEAST_COLUMNS` columns.

    Examples
    --------
    >>> projections -= ring_offsets(projections)
    """
    n, rows, columns = projections.shape
    require_enough(n, columns)
    offsets = np.zeros((rows, columns), np.float32)
    step = max(1, MOST_PIXELS // (n * columns))
    for first in range(0, rows, step):
        some = slice(first, first + step)
        block = np.asarray(projections[:, some])  # an array in chunks is read whole for it
        for k in range(block.shape[1]):
            inside = None if valid is None else valid[:, first + k]
            offsets[first + k] = _of_row(block[:, k].astype(float), inside)
    return offsets


def require_enough(n: int, columns: int) -> None:
    """Raises InputError for fewer than `LEAST_VIEWS` views or `LEAST_COLUMNS` columns."""
    if n < LEAST_VIEWS or columns < LEAST_COLUMNS:
        raise InputError(
            f'rings differ from the object in {LEAST_VIEWS} or more views of {LEAST_COLUMNS} or more columns, not in {n} of '
            f'{columns}: leave rings out, and let a fit find the offsets of pixels (fit_pixels=one)'
        )


def _of_row(sinogram: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    """The offsets [u] of one row of the panel, whose line integrals are [view, u]."""
    if valid is not None and not valid.all():
        sinogram = np.array([_without_gaps(*view) for view in zip(sinogram, valid)])
    offsets = np.zeros(sinogram.shape[1])
    for _ in range(PASSES):
        left = sinogram - offsets
        offsets += np.median(left - np.asarray(savgol_filter(left, WINDOW, DEGREE, axis=1)), 0)
    return offsets if valid is None else np.where(2 * valid.sum(0) >= len(valid), offsets, 0)


def _without_gaps(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Values along a row, interpolated where they are not valid."""
    if not valid.any():
        return np.zeros_like(values)
    place = np.arange(len(values))
    return np.interp(place, place[valid], values[valid])
