"""Finding a scanner's errors of geometry before a fit."""

from __future__ import annotations

import warnings

from lingo_mi.calibration.calibration import Calibration
from lingo_mi.calibration.order import order_faults
from lingo_mi.calibration.response.response import Response
from lingo_mi.calibration.search import search
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole_number
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import drjit_lock, ensure_variant
from lingo_mi.inspection.air import air_of, steady
from lingo_mi.inspection.measure import warn_of_intensities
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.scan import Dataset, Scan

MOST_DEGREE, MOST_CURVE = 8, 3
NO_AIR = (
    'no edge of the panel shows air in all views, so a drift of the beam may have been taken for geometry: compare with what '
    '--air (air=True) finds'
)


@drjit_lock()
def calibrate(
    scan: Scan | Dataset,
    *,
    drift: int = 0,
    air: bool = False,
    gain: bool = False,
    curve: int = 0,
    scatter: bool = False,
    progress: bool = True,
) -> Calibration:
    """Find where the panel really is: its shift along u, its turn in its own plane, and its drift over the scan.

    An axis of rotation off centre is a shift along u. On request, the response of the detector to line integrals is found, too.

    Quick reconstructions on few voxels predict the views, and the search looks for the panel with which predicted and measured
    views agree best (`lingo_mi.calibration.search`). It takes some 30 such reconstructions, and 6 more for each further unknown.
    It does not look for a constant shift along v, which is hard to distinguish from an object that lies higher. A drifting beam
    looks like a panel that moves. If an edge of the panel shows air in all views, the level of air is therefore subtracted from
    each view first.

    Parameters
    ----------
    scan : Scan or Dataset
        At least 8 views, in the order in which they were taken. A `Dataset` gives its `train`.
    drift : int
        Degree of a polynomial in time for the shifts along u and v. With 0 the panel does not drift.
    air : bool
        Whether to fit an air level, a cubic polynomial in time, instead of reading it beside the object.
    gain : bool
        Whether to fit a gain of the views, also a cubic polynomial in time, near 1.
    curve : int
        Number of coefficients, 0 to 3, of the curve from line integral to measured value. Beam hardening makes such a curve.
    scatter : bool
        Whether to fit scattered light, the same smooth image in all views.
    progress : bool
        Whether to show a progress bar on standard error.

    Returns
    -------
    Calibration
        `lines()` lists the results with their standard errors, and `corrected(data)` is the corrected scan. A number within three
        standard errors of zero is not corrected, and neither is scattered light that would be negative in places. A warning says
        if the views contradict their angles or their order, because the results are then meaningless.

    Raises
    ------
    InputError
        For fewer than 8 views, and a scan without signal.

    Examples
    --------
    >>> calibration = lm.calibrate(data, drift=3)
    >>> data = calibration.corrected(data)
    """
    ensure_variant()
    require_type('scan', scan, (Scan, Dataset))
    drift = whole_number('drift', drift, 0)
    if drift > MOST_DEGREE:
        raise InputError(f'drift is the degree of a polynomial, 0 to {MOST_DEGREE}, not {drift}')
    curve = whole_number('curve', curve, 0)
    if curve > MOST_CURVE:
        raise InputError(f'curve is a number of coefficients, 0 to {MOST_CURVE}, not {curve}')
    for name, value in dict(air=air, gain=gain, scatter=scatter).items():
        require_type(name, value, bool)
    train = scan.train if isinstance(scan, Dataset) else scan
    warn_of_intensities(train)
    measured, level, notes = line_integrals(train), None, ()
    if not (air or scatter):  # scattered light shows beside the object, too
        notes = (NO_AIR,) if air_of(measured) is None else ()
        measured, level = steady(measured)
    with Progress('Calibrate', 1, shown=progress) as bar:

        def report(done, total):
            bar.total = total
            bar.update(done)

        response = Response.of(
            train.geometry,
            air='smooth' if air else 'off',
            gain='smooth' if gain else 'off',
            curve=curve,
            scatter='one' if scatter else 'off',
            highest=max(float(measured.projections.max()), 1e-6),
        )
        calibration = Calibration(train.geometry, search(measured, drift, response, report), level, notes)
    for fault in order_faults(calibration.corrected(train)):
        warnings.warn(fault, stacklevel=2)
    return calibration
