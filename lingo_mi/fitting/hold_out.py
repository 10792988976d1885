"""The views that a fit of measured projections leaves out, to measure how well it predicts views that it has not seen."""

from __future__ import annotations

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import whole_number
from lingo_mi.reconstruction.held_out import LEAST_VIEWS, held_out_views
from lingo_mi.scan import Dataset, Scan

EVERY = 10  # one view in so many is held out of a measured scan,
LEAST = 20  # if it has so many


def with_held_out(scan: Scan | Dataset, every: int | None) -> Dataset:
    """The scan with evenly spaced views held out.

    Parameters
    ----------
    every : int or None
        One view in so many is held out; 0: none. None: 10 of a data set of 20 views or more that has neither held-out views
        nor a true volume, else 0.

    Raises
    ------
    InputError
        If `every` is 1 or negative, if the scan has fewer than four views, or held-out views already.

    Examples
    --------
    >>> data = with_held_out(Dataset(scan), 10)
    """
    dataset = scan if isinstance(scan, Dataset) else Dataset(scan)
    train, test = dataset.train, dataset.test
    if every is None:
        measured = scan is dataset and test is None and dataset.volume is None
        every = EVERY if measured and len(train) >= LEAST else 0
    elif whole_number('hold_out', every, 0) == 1:
        raise InputError('hold_out=1 leaves no view to fit: give 0, or N from 2 on to hold out one view in N')
    if not every:
        return dataset
    if test is not None:
        raise InputError(f'hold_out={every}: the scan has {len(test)} held-out views already; leave hold_out out')
    if len(train) < LEAST_VIEWS:
        raise InputError(f'hold_out={every} needs {LEAST_VIEWS} views or more, but the scan has {len(train)}')
    held = held_out_views(len(train), every)
    if train.valid is not None:
        held = held[train.valid[held].any((1, 2))]
    if not len(held):
        return dataset
    return Dataset(train.subset(np.setdiff1d(np.arange(len(train)), held)), train.subset(held), dataset.volume)
