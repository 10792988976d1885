"""Options of an import: `Options`, and its values that depend on the frames."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import checked, whole_number


@dataclass(frozen=True)
class Options:
    """Options that turn frames into line integrals.

    Parameters
    ----------
    flats, darks : path-like or None
        Files or folders of their own; None: the fields of the recording, if it has any.
    air : tuple[int, int, int, int] or None
        (v0, v1, u0, u1), pixels of the whole frame where no view has an object: their mean is the air level of a view.
    percentile : float or None
        Instead: that percentile of a view is its air level.
    i0 : float or None
        Instead: counts of the unattenuated beam.
    exposure
        [n] or one number: exposure of every view over the exposure of the flats.
    saturation : float or None
        Counts from here on are not valid; None: the largest value of the integer type of views and of flats.
    crop : tuple[int, int, int, int] or None
        (v0, v1, u0, u1), pixels of the whole frame to keep.
    binning : int
        Pixels (v and u) that become one.
    views : tuple[int, int or None, int] or None
        (first, end, step) of the views to keep; the end may be None.
    angles
        [n] degrees or the file that lists them, if the geometry does not.
    pixel : float or None
        Size of a raw pixel, mm; for a geometry of RTK.
    rings : bool
        Whether what each pixel adds in all views is subtracted, see `lingo_mi.raw.rings`.
    outliers : bool
        Whether pixels far brighter than their neighbours are left out, see `line_integrals.bright_outliers`.
    """

    flats: PathLike | str | None = None
    darks: PathLike | str | None = None
    air: tuple[int, int, int, int] | None = None
    percentile: float | None = None
    i0: float | None = None
    exposure: Any = 1.0
    saturation: float | None = None
    crop: tuple[int, int, int, int] | None = None
    binning: int = 1
    views: tuple[int, int | None, int] | None = None
    angles: Any = None
    pixel: float | None = None
    rings: bool = False
    outliers: bool = False

    def __post_init__(self):
        """Raises InputError for values of another kind; those that depend on the frames are checked with them."""
        for name in 'percentile', 'i0', 'saturation', 'pixel':
            if getattr(self, name) is not None:
                checked(name, getattr(self, name), 0.0)
        whole_number('binning', self.binning, 1)
        require_type('rings', self.rings, bool)
        require_type('outliers', self.outliers, bool)
        try:
            first, end, step = (0, None, 1) if self.views is None else self.views
            for value in (first, 0 if end is None else end, step):
                operator.index(value)
        except (TypeError, ValueError):
            raise InputError(
                f'views must be (first, end, step), the end a number or None, not {self.views!r}'
            ) from None


def region_of(name: str, region: Any, shape: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """A region (v0, v1, u0, u1), which must lie in a frame; None for None."""
    if region is None:
        return None
    try:
        v0, v1, u0, u1 = (int(x) for x in region)
    except (TypeError, ValueError):
        raise InputError(f'{name} must be four whole numbers, (v0, v1, u0, u1), not {region!r}') from None
    if not (0 <= v0 < v1 <= shape[0] and 0 <= u0 < u1 <= shape[1]):
        raise InputError(
            f'{name} = {(v0, v1, u0, u1)} does not lie in a frame of {shape} pixels; it is (v0, v1, u0, u1)'
        )
    return v0, v1, u0, u1


def chosen_views(views: tuple[int, int | None, int] | None, n: int) -> np.ndarray:
    """The numbers of the views to keep, of n."""
    index = np.arange(n)
    if views is not None:
        first, end, step = views
        index = index[first:end:step] if step > 0 else index[:0]
    if not len(index):
        raise InputError(f'no view is left of {n}; views are (first, end, step)')
    return index


def exposures(exposure: Any, n: int) -> np.ndarray:
    """The exposure of each of n views."""
    try:
        values = np.asarray(exposure, float)
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if values.shape not in ((), (1,), (n,)) or not np.all(values > 0):
        raise InputError(f'exposure must be one positive number, or one for each of {n} views')
    return np.broadcast_to(values, (n,))
