"""Finding a scanner's errors of geometry before a fit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from lingo_mi.calibration.order import order_faults
from lingo_mi.calibration.response.response import Response
from lingo_mi.calibration.search import Found, search
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import ensure_variant, one_at_a_time
from lingo_mi.geometry import Geometry
from lingo_mi.reconstruction.effects_correction import linearised
from lingo_mi.scan import Dataset, Scan

MOST_DEGREE, MOST_CURVE = 8, 3
_TERMS = dict(
    air='air level',
    gain='gain over 1',
    curve='curve, coefficients from the square on',
    scatter='scatter over the open beam',
)


@dataclass(frozen=True)
class Calibration:
    """What `lm.calibrate` has found; `corrected` is the scan with it.

    geometry    of the scan that was given
    found       numbers, their standard errors, and how well views predict each other before and after
    """

    geometry: Geometry
    found: Found

    @property
    def needed(self) -> bool:
        """Whether anything was found that is taken."""
        drift = self.found.drift
        return any(drift.u) or any(drift.v) or bool(drift.yaw) or self._response is not None

    @property
    def _response(self) -> Response | None:
        """The response, if any of its numbers was found."""
        response = self.found.response
        return response if response is not None and any(part.values.any() for part in response.parts) else None

    def corrected(self, scan: Scan | Dataset) -> Scan | Dataset:
        """The same views with the panel where it was found. Views that were held out get what was found for their time, which
        their angles tell: the scan's views must be in the order in which they were taken.

        Raises InputError for a scan by another scanner.
        """
        require_type('scan', scan, (Scan, Dataset))
        if isinstance(scan, Dataset):
            test = None if scan.test is None else self._moved(scan.test)
            return replace(scan, train=self._moved(scan.train), test=test)
        return self._moved(scan)

    def _moved(self, scan: Scan) -> Scan:
        if scan.geometry.mode != self.geometry.mode or scan.geometry.nDetector != self.geometry.nDetector:
            raise InputError('this calibration is that of a scan by another scanner: calibrate this one')
        if not self.needed:
            return scan
        response = self._response
        if response is not None:
            if scan.effects is not None:  # it was found on line integrals
                scan = linearised(scan, scan.effects)
            scan = replace(scan, projections=response.undone(scan.projections, scan.geometry))
        return replace(scan, geometry=self.found.drift.panel(scan.geometry).moved(scan.geometry))

    def lines(self) -> list[str]:
        """What was found, in sentences."""
        f, pixel = self.found, dict(zip('vu', self.geometry.dDetector))
        told = []
        for name, value in f.measured.items():
            error, why = f.errors[name], f.refused.get(name)
            if name == 'yaw':
                text = f'panel turned in its plane by {np.degrees(value):+.3f} degrees +- {np.degrees(error):.3f}'
            elif name[0] not in 'uv':
                text = f'{_TERMS[name.rstrip("0123456789_")]} ({name}): {value:+.3g} +- {error:.2g}'
            else:
                what = 'shift' if len(name) == 1 else f'drift of order {name[1:]}'
                pixels = value / pixel[name[0]]
                text = f'{what} of the panel along {name[0]}: {value:+.4g} mm +- {error:.2g} ({pixels:+.3f} pixels)'
            told.append(text + (f', not taken: {why}' if why else ''))
        told.append(
            f'views predict each other to {f.after:.4g} rms instead of {f.before:.4g} (line integrals, smoothed)'
        )
        return told


@one_at_a_time()
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
    """Find where the panel really is: its shift along u, as of an axis of rotation off centre; its turn in its own plane; and its
    drift over the scan. If asked for, also what the detector makes of line integrals.

    scan       at least 8 views, in the order in which they were taken; of a `Dataset` its `train`
    drift      degree of a polynomial in time for the shifts along u and v; 0: the panel does not drift
    air        whether to seek an air level, a cubic polynomial in time
    gain       whether to seek a gain of the views, likewise, about 1
    curve      coefficients, 0 to 3, of the curve from line integral to measured value, as of beam hardening
    scatter    whether to seek scattered light, the same smooth image in all views
    progress   whether to show a progress bar on standard error

    Views are predicted from quick reconstructions of other views, on few voxels, and are to agree with them (see
    `lingo_mi.calibration.search`). Takes some 30 such reconstructions, and 6 for each further number. A constant shift along v
    can hardly be told from an object that lies higher, and is not sought.

    Returns a `Calibration`: `lines()` says what was found and how surely, `corrected(data)` is the scan with it. What is less
    than three standard errors from zero is left as it was, as is scattered light that would be negative in places. Warns where
    the views contradict their angles or their order: what is found then means nothing. Raises InputError for fewer than 8 views,
    and a scan without signal.

        calibration = lm.calibrate(data, drift=3)
        data = calibration.corrected(data)
    """
    ensure_variant()
    require_type('scan', scan, (Scan, Dataset))
    drift = whole('drift', drift, 0)
    if drift > MOST_DEGREE:
        raise InputError(f'drift is the degree of a polynomial, 0 to {MOST_DEGREE}, not {drift}')
    curve = whole('curve', curve, 0)
    if curve > MOST_CURVE:
        raise InputError(f'curve is a number of coefficients, 0 to {MOST_CURVE}, not {curve}')
    for name, value in dict(air=air, gain=gain, scatter=scatter).items():
        require_type(name, value, bool)
    train = scan.train if isinstance(scan, Dataset) else scan
    measured = train if train.effects is None else linearised(train, train.effects)
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
        calibration = Calibration(train.geometry, search(measured, drift, response, report))
    for fault in order_faults(calibration._moved(measured)):
        warnings.warn(fault, stacklevel=2)
    return calibration
