"""Consistency of the angles, order and geometry of the views: if they are right, views predict each other.

Every view is predicted from a quick reconstruction of other views (`cross_prediction`), with the views as given, in the opposite
sense, and in a random order. On sound scans of 20 views or more (of a walnut and a disc with holes, measured, and eight simulated
objects, over 60 to 360 degrees) a random order makes the differences 2 to 60 times as large, and the opposite sense at least as
large. Over half a turn of a parallel beam it mirrors the object, so there it is not tried. The beam's drift is removed first
(`inspection.air`), since it disturbs the comparison. If the angles belong to other views, a random order makes the differences
0.9 to 1.6 times as large.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from lingo_mi.calibration.cross_prediction import coarse, cross_predicted, folds_of
from lingo_mi.inspection.air import steady
from lingo_mi.reconstruction.preconditions import require_rays, require_signal
from lingo_mi.scan import Scan

PIXELS, MOST_VIEWS, LEAST_VIEWS = 32, 60, 20
WORSE = 1.8  # least factor by which a random order makes the differences larger
REVERSED = 0.9  # if the opposite sense makes the differences smaller than this part, it is right
ROUND = 0.05  # part of the views' signal: with smaller differences, the object looks alike from everywhere
ODD = 5.0  # a view out of place differs so many times as much as the median of all, and of its neighbours
NEIGHBOURS = 5  # views, in the order of the scan


def order_faults(scan: Scan) -> list[str]:
    """Describe contradictions between the projections and the angles or the order of the views, in sentences. The list is
    empty for a sound scan and for a scan of few views.

    Of many views, evenly spaced ones are compared. Takes four quick reconstructions.

    Raises
    ------
    InputError
        For a scan without signal, and if the source lies within the volume.

    Examples
    --------
    >>> order_faults(scan)  # ['the views predict each other hardly better than in a random order: ...']
    """
    require_signal(scan, 'compare')
    require_rays(scan.geometry)
    n = len(scan)
    if n < LEAST_VIEWS:
        return []
    index = np.unique(np.round(np.linspace(0, n - 1, min(n, MOST_VIEWS))).astype(int))
    small = coarse(steady(scan)[0].subset(index), PIXELS)
    turn, shuffled = np.arange(len(index))[::-1], np.random.default_rng(0).permutation(len(index))
    differences = _differences(small)
    total = np.sqrt(np.square(differences).mean())
    signal = np.sqrt(np.square(small.projections).mean())

    def times(order):
        """Return the factor by which the differences grow if the views of this order take the places of the original views."""
        return np.sqrt(np.square(_differences(replace(small.subset(order), geometry=small.geometry))).mean()) / total

    if total > ROUND * signal and times(shuffled) < WORSE:
        return [
            'the views predict each other hardly better than in a random order: check the angles (one for each view, and their '
            'unit), the order of the frames, and the distances'
        ]
    # A parallel beam does not determine the sense: the mirrored object explains reversed angles as well.
    if scan.geometry.mode == 'cone' and (opposite := times(turn)) < REVERSED:
        return [
            f'with reversed angles the views predict each other {1 / opposite:.2g} times as well: change the sign of the '
            'angles, or mirror the columns'
        ]
    # Errors of the geometry grow and fall slowly from view to view; a view out of place stands out from its neighbours.
    others = ndimage.median_filter(differences, NEIGHBOURS, mode='mirror')
    odd = index[differences > ODD * np.maximum(np.median(differences), others)]
    if not len(odd):
        return []
    named = ', '.join(map(str, odd[:6])) + (', ...' if len(odd) > 6 else '')
    return [
        f'{"view" if len(odd) == 1 else "views"} {named}: predicted by the others at least {ODD:.0f} times worse than the rest; '
        'out of order, doubled or damaged?'
    ]


def _differences(scan: Scan) -> np.ndarray:
    """Root mean square of measured less predicted line integrals, of every view [n]."""
    r = scan.projections - cross_predicted(scan, folds_of(scan.geometry))
    if scan.valid is not None:
        r = np.where(scan.valid, r, 0)
    return np.sqrt(np.square(r, dtype=np.float64).mean((1, 2)))
