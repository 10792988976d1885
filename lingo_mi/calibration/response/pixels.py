"""Offsets of pixels: every pixel adds the same value to its line integrals in all views, because the flat fields missed its
gain.

    m = p + o          o = -ln of a pixel's gain

As the variable for rings in Paleo and Mirone, J. Synchrotron Rad. 22 (2015), found from the residual of the object so far. What
is smooth across the panel is left to the object, since views hardly tell the two apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from lingo_mi.calibration.response.part import ResponsePart

SMOOTH = 9  # side in pixels of squares: their median is left to the object
MEDIAN = 1.4826 * 1.2533  # times the median deviation over the root of n: the standard error of a median
SURE = 3.0  # an offset of fewer standard errors counts as 0


@dataclass
class Pixels(ResponsePart):
    """The offset o of each pixel of a panel of this shape (v, u). No least squares hold so many numbers: `find` finds them."""

    name = 'pixels'

    shape: tuple[int, int] = (1, 1)

    @property
    def deviations(self):
        return np.ones(self.shape[0] * self.shape[1])

    def apply(self, p, c, place):
        return p + c.reshape(self.shape)

    def undo(self, m, c, place):
        return m - c.reshape(self.shape)

    def slopes(self, p, c, place):
        raise NotImplementedError  # see `find`

    def find(self, expected: np.ndarray, measured: np.ndarray, valid: np.ndarray | None) -> None:
        """Take the median over the views [view, v, u] of what was measured less what was expected, without what is smooth. Where
        the views do not agree, because the object is not yet found, the offset is made smaller."""
        residual = measured.astype(float) - expected
        if valid is not None:
            residual = np.where(valid, residual, np.nan)
            residual[:, ~valid.any(0)] = 0  # no view has a value to take the median of
        middle = np.nanmedian(residual, 0)
        size = np.minimum(SMOOTH, self.shape)
        offset = middle - median_filter(middle, tuple(size), mode='nearest')
        error = MEDIAN * np.nanmedian(np.abs(residual - middle), 0) / np.sqrt(len(residual))
        share = 1 - np.square(SURE * error / np.maximum(np.abs(offset), 1e-12))
        self.values = (np.maximum(share, 0) * offset).reshape(1, -1)

    def report(self, c):
        return {'pixel_offset_rms': [float(np.sqrt(np.square(c).mean()))]}
