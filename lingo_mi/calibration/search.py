"""The panel's place, and a response of the detector, by a search from coarse to fine: views are to predict each other best.

Every view is predicted from a quick reconstruction of other views (`cross_prediction`). With r the differences to what was
measured, as a function of the numbers sought, and D the derivatives of r by differences (of the whole chain, each with two
reconstructions of its own), a step is that of Gauss and Newton, -(D D^T)^-1 D r. The shift along u is first looked for on
a grid of trials. Views are independent, so the standard errors are those of clustered observations,

    (D D^T)^-1  (sum over views of g g^T)  (D D^T)^-1,   g = D r of a view

(Liang and Zeger, Biometrika 73, 1986). A constant shift along v is not sought: the image moves by it almost as if the object had
moved along the axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lingo_mi.calibration.cross_prediction import coarse, cross_predicted, folds_of
from lingo_mi.calibration.drift import Drift
from lingo_mi.calibration.response.part import SURE
from lingo_mi.calibration.response.response import Response
from lingo_mi.common.errors import InputError
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.scan import Scan

FIRST, FINE = 32, (32, 48)  # columns of the binned panel: for trials, and for one step each
MOST_VIEWS = 60
REACH = 0.06  # of the panel's width: how far off an axis is looked for
SINGULAR = 1e-12  # of the largest eigenvalue of the normal equations
LONGEST = 4.0  # steps for differences that a number may change by at a time


@dataclass(frozen=True)
class Found:
    """What the search has found.

    drift       the panel's place over the scan; a number that is not taken is 0 in it
    response    of the detector, likewise; None if none was sought
    measured    all numbers as measured, by name, as `Drift.of` (mm, radians) and `Response.changed` have them
    errors      their standard errors
    refused     why a number is not taken, by name
    before, after   root mean square difference between predicted and measured views, as given and with `drift`
    """

    drift: Drift
    response: Response | None
    measured: dict[str, float]
    errors: dict[str, float]
    refused: dict[str, str]
    before: float
    after: float


class _Level:
    """The differences of a scan binned to some size, and what moves its images by a pixel, for each number by name."""

    def __init__(self, scan: Scan, pixels: int, names: list[str], response: Response | None, count: Callable[[], None]):
        self.scan, self.count, self.names, self.response = coarse(scan, pixels), count, names, response
        self.folds = folds_of(self.scan.geometry)
        (nv, nu), (dv, du) = self.scan.geometry.nDetector, self.scan.geometry.dDetector
        pixel = dict(u=du, v=dv, y=2 / max(nv, nu))  # of the yaw at the panel's edge
        self.steps = {name: 0.5 * pixel[name[0]] for name in names if name[0] in pixel}
        self.steps |= {} if response is None else response.names()

    def differences(self, numbers: dict[str, float]) -> np.ndarray:
        """Measured less predicted, [view, v, u], zero where it does not count."""
        scan = self.scan
        places = {name: value for name, value in numbers.items() if name[0] in 'uvy'}
        moved = Drift.of(scan.geometry, places).panel(scan.geometry).resampled(scan)
        inside = np.ones(moved.projections.shape, bool) if moved.valid is None else moved.valid
        if scan.valid is None:  # the panel's edge is no fault of a pixel, and plain scans are reconstructed faster
            moved = replace(moved, valid=None)
        measured = moved.projections
        if self.response is None:
            expected = cross_predicted(moved, self.folds)
        else:
            response = self.response.changed(numbers)
            line_integrals = response.undone(measured, moved.geometry)
            expected = cross_predicted(replace(moved, projections=line_integrals), self.folds)
            expected = response.applied(expected, moved.geometry)
        r = np.where(inside, measured - expected, 0)
        self.count()
        return r.astype(float)

    def derivatives(self, here: dict[str, float]) -> np.ndarray:
        """Of the differences, by central differences, of half a pixel for what moves: [number, view, v, u]."""
        found = []
        for name in self.names:
            h = self.steps[name]
            ends = [self.differences(here | {name: here[name] + sign * h}) for sign in (1, -1)]
            found.append((ends[0] - ends[1]) / (2 * h))
        return np.array(found)

    def stepped(self, here: dict[str, float], r: np.ndarray, D: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
        """A step of limited length, or half of it, or none: where the differences are smaller; and these."""
        step = _step(r, D)
        step = step / max(max(abs(s) / (LONGEST * self.steps[name]) for s, name in zip(step, self.names)), 1.0)
        for share in (1.0, 0.5):
            trial = here | {name: here[name] + share * float(s) for name, s in zip(self.names, step)}
            there = self.differences(trial)
            if np.square(there).sum() < np.square(r).sum():
                return trial, there
        return here, r


def search(
    scan: Scan, degree: int = 0, response: Response | None = None, progress: Callable[[int, int], None] | None = None
) -> Found:
    """The panel's place, its drift over the scan, and a response of the detector.

    degree     of the drift's polynomial in time; 0: no drift
    response   of the scan's geometry, with the parts that are sought; None: projections are line integrals
    progress   called as progress(trials done, trials) after every quick reconstruction

    Raises InputError for a scan of fewer than 8 views or without signal.
    """
    require_signal(scan, 'calibrate')
    if len(scan) < 8:
        raise InputError(f'a calibration compares views with each other and needs at least 8, not {len(scan)}')
    whole = scan
    if len(scan) > MOST_VIEWS:
        scan = scan.subset(np.unique(np.round(np.linspace(0, len(scan) - 1, MOST_VIEWS)).astype(int)))
    names = [*_determined(scan, degree), *(response.names() if response else ())]
    zero = dict.fromkeys(names, 0.0)
    trials = np.arange(-REACH, REACH + 1e-9, 0.6 / FIRST) * scan.geometry.sDetector[1]
    total, done = len(trials) + len(FINE) * (2 + 2 * len(names)) + 2, 0

    def count():
        nonlocal done
        done += 1
        if progress:
            progress(min(done, total), total)

    first = _Level(scan, FIRST, names, response, count)
    costs = [np.square(first.differences(zero | {'u': float(u)})).sum() for u in trials]
    here = zero | {'u': float(trials[int(np.argmin(costs))])}
    for pixels in FINE:
        level = _Level(scan, pixels, names, response, count)
        r = level.differences(here)
        D = level.derivatives(here)
        here, r = level.stepped(here, r, D)
    errors = dict(zip(names, map(float, _standard_errors(r, D))))
    given = level.differences(zero)
    small = [name for name in names if not abs(here[name]) > SURE * errors[name]]
    refused = dict.fromkeys(small, 'it is less than three standard errors')
    chosen, best = here, r
    while True:
        sure = [name for name in names if name not in refused]
        if sure and len(sure) < len(names):  # once more, with the others as given
            level.names, kept = sure, D[[names.index(name) for name in sure]]
            chosen = zero | {name: here[name] for name in sure}
            chosen, best = level.stepped(chosen, level.differences(chosen), kept)
        doubted = response.doubts(chosen, {name: errors[name] for name in sure}) if response and sure else {}
        if not doubted:
            break
        refused = doubted | refused
    if not sure or np.square(best).sum() >= np.square(given).sum():
        chosen, best = zero, given
        refused = dict.fromkeys(sure, 'views do not predict each other better') | refused
    return Found(
        Drift.of(whole.geometry, {name: value for name, value in chosen.items() if name in _determined(scan, degree)}),
        response and response.changed(chosen),
        here,
        errors,
        refused,
        float(np.sqrt(np.square(given).mean())),
        float(np.sqrt(np.square(best).mean())),
    )


def _determined(scan, degree):
    """Which numbers a scan tells: of one row neither height nor turn."""
    drifts = range(1, degree + 1)
    names = ['u', *(f'u{k}' for k in drifts)]
    if min(scan.geometry.nDetector) < 8 or scan.geometry.grid.shape[2] == 1:
        return names
    return [*names, 'yaw', *(f'v{k}' for k in drifts)]


def _step(r, D):
    flat = D.reshape(len(D), -1)
    return -np.linalg.pinv(flat @ flat.T, rcond=SINGULAR, hermitian=True) @ (flat @ r.ravel())


def _standard_errors(r, D):
    flat = D.reshape(len(D), -1)
    matrix = flat @ flat.T
    inverse = np.linalg.pinv(matrix, rcond=SINGULAR, hermitian=True)
    g = np.einsum('knvu,nvu->nk', D, r)
    errors = np.sqrt(np.diag(inverse @ (g.T @ g) @ inverse))
    return np.where(np.diag(matrix @ inverse) > 0.5, errors, np.inf)  # a number without effect is not known
