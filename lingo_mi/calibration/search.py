"""The panel's place, and a response of the detector, by a search from coarse to fine: views are to predict each other best.

Every view is predicted from a quick reconstruction of other views (`cross_prediction`). With r the differences to what was
measured, as a function of the numbers sought, and D the derivatives of r by differences (of the whole chain, each with two
reconstructions of its own), a step is a Gauss-Newton step, -(D D^T)^-1 D r. The shift along u is first looked for on
a grid of trials, a wide one if no minimum is clear.

The panel moves, and the images stay as they were measured. So all pixels count in all trials: if images were moved instead,
images of an object that reaches over the panel's edge would lose or gain pixels, and the smallest sum would have the fewest.

Standard errors are for clustered observations,

    K / (K - 1)  (D D^T)^-1  (sum over K clusters of g g^T)  (D D^T)^-1,   g = D r of a cluster

(Liang and Zeger, Biometrika 73, 1986). Clusters are single views, which noise makes differ; the halves that predict each other;
and spans of the scan's time, which differ if the scanner changes. The largest counts. A constant shift along v is not sought:
the image moves by it almost as if the object had moved along the axis.
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
REACH, FARTHEST = 0.06, 0.5  # parts of the panel's width: an axis is sought so far off at first, and at most
TRIAL = 0.6 / FIRST  # part of the panel's width: between trials
CLEAR = 0.5  # part of the trials' largest sum of squares: if the smallest is above it, it is not a minimum
SINGULAR = 1e-12  # of the largest eigenvalue of the normal equations
LONGEST = 4.0  # most that a number changes at a time, in steps for differences
AGAIN = 3  # more steps, at most, with the last derivatives, until they are within the standard errors
SPANS = 6  # spans of the scan's time, for standard errors
FLOOR = 0.03  # least standard error, in steps for differences: voxels are not the object


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Parameters
    ----------
    drift : Drift
        The panel's place over the scan; a number that is not taken is 0 in it.
    response : Response or None
        Response of the detector, likewise; None if none was sought.
    measured : dict[str, float]
        All numbers as measured, by name, as `Drift.of` (mm, radians) and `Response.changed` have them.
    errors : dict[str, float]
        Their standard errors.
    refused : dict[str, str]
        Why a number is not taken, by name.
    before, after : float
        Root mean square difference between predicted and measured views, as given and with `drift`.
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
        pixel = dict(u=du, v=dv, y=2 / max(nv, nu))  # a pixel of yaw is meant at the panel's edge
        self.steps = {name: 0.5 * pixel[name[0]] for name in names if name[0] in pixel}
        self.steps |= {} if response is None else response.names()

    def differences(self, numbers: dict[str, float]) -> np.ndarray:
        """Measured less predicted, [view, v, u], zero where it does not count."""
        places = {name: value for name, value in numbers.items() if name[0] in 'uvy'}
        geometry = self.scan.geometry
        scan = replace(self.scan, geometry=Drift.of(geometry, places).panel(geometry).moved(geometry))
        measured = scan.projections
        if self.response is None:
            expected = cross_predicted(scan, self.folds)
        else:
            response = self.response.changed(numbers)
            expected = cross_predicted(replace(scan, projections=response.undone(measured, geometry)), self.folds)
            expected = response.applied(expected, geometry)
        self.count()
        r = (measured - expected).astype(float)
        return r if scan.valid is None else np.where(scan.valid, r, 0)

    def derivatives(self, here: dict[str, float]) -> np.ndarray:
        """Return the derivatives of the differences, [number, view, v, u], by central differences; motions have steps of half a
        pixel."""
        derivatives = []
        for name in self.names:
            h = self.steps[name]
            ends = [self.differences(here | {name: here[name] + sign * h}) for sign in (1, -1)]
            derivatives.append((ends[0] - ends[1]) / (2 * h))
        return np.array(derivatives)

    def stepped(self, here: dict[str, float], r: np.ndarray, D: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
        """A step of limited length, half of it, or none, whichever has smaller differences; and these."""
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
) -> SearchResult:
    """The panel's place, its drift over the scan, and a response of the detector.

    Parameters
    ----------
    degree : int
        Degree of the drift's polynomial in time; 0: no drift.
    response : Response or None
        Response of the scan's geometry, with the parts that are sought; None: projections are line integrals.
    progress : callable or None
        Called as progress(trials done, trials) after every quick reconstruction.

    Raises
    ------
    InputError
        For a scan of fewer than 8 views or without signal.
    """
    require_signal(scan, 'calibrate')
    if len(scan) < 8:
        raise InputError(f'a calibration compares views with each other and needs at least 8, not {len(scan)}')
    whole = scan
    if len(scan) > MOST_VIEWS:
        scan = scan.subset(np.unique(np.round(np.linspace(0, len(scan) - 1, MOST_VIEWS)).astype(int)))
    names = [*_determined(scan, degree), *(response.names() if response else ())]
    zero = dict.fromkeys(names, 0.0)
    total, done = round(2 * REACH / TRIAL) + 1 + len(FINE) * (2 + 2 * len(names)) + 3, 0

    def count():
        nonlocal done
        done += 1
        if progress:
            progress(min(done, total), total)

    first = _Level(scan, FIRST, names, response, count)
    start, between = _axis(first, zero)
    here = zero | {'u': start}
    for pixels in FINE:
        level = _Level(scan, pixels, names, response, count)
        r = level.differences(here)
        D = level.derivatives(here)
        here, r = level.stepped(here, r, D)
    for _ in range(AGAIN):
        errors, left = _standard_errors(r, D, level), _step(r, D)
        if (np.abs(left) <= errors).all():
            break
        before, (here, r) = here, level.stepped(here, r, D)
        if here is before:
            break
    errors = dict(zip(names, map(float, np.maximum(_standard_errors(r, D, level), np.abs(_step(r, D))))))
    unchanged = level.differences(zero)
    small = [name for name in names if not abs(here[name]) > SURE * errors[name]]
    refused = dict.fromkeys(small, 'it is less than three standard errors')
    if not between:
        refused |= dict.fromkeys(names, 'the axis lies outside the searched range: check offDetector and the angles')
    chosen, best = here, r
    while True:
        sure = [name for name in names if name not in refused]
        if sure and len(sure) < len(names):  # once more, with the others left as given
            level.names, rows = sure, D[[names.index(name) for name in sure]]
            chosen = zero | {name: here[name] for name in sure}
            chosen, best = level.stepped(chosen, level.differences(chosen), rows)
        doubted = response.doubts(chosen, {name: errors[name] for name in sure}) if response and sure else {}
        if not doubted:
            break
        refused = doubted | refused
    if not sure or np.square(best).sum() >= np.square(unchanged).sum():
        chosen, best = zero, unchanged
        refused = dict.fromkeys(sure, 'views do not predict each other better') | refused
    return SearchResult(
        Drift.of(whole.geometry, {name: value for name, value in chosen.items() if name in _determined(scan, degree)}),
        response and response.changed(chosen),
        here,
        errors,
        refused,
        float(np.sqrt(np.square(unchanged).mean())),
        float(np.sqrt(np.square(best).mean())),
    )


def _determined(scan, degree):
    """Return the numbers that a scan determines. A scan of one row determines neither height nor turn."""
    drifts = range(1, degree + 1)
    names = ['u', *(f'u{k}' for k in drifts)]
    if min(scan.geometry.nDetector) < 8 or scan.geometry.grid.shape[2] == 1:
        return names
    return [*names, 'yaw', *(f'v{k}' for k in drifts)]


def _step(r, D):
    flat = D.reshape(len(D), -1)
    return -np.linalg.pinv(flat @ flat.T, rcond=SINGULAR, hermitian=True) @ (flat @ r.ravel())


def _standard_errors(r, D, level):
    """The largest of those by single views, by folds and by spans of time; not below `FLOOR`."""
    flat, n = D.reshape(len(D), -1), r.shape[0]
    matrix = flat @ flat.T
    inverse = np.linalg.pinv(matrix, rcond=SINGULAR, hermitian=True)
    g = np.einsum('knvu,nvu->nk', D, r)
    spans = [np.arange(n)[part] for part in np.array_split(np.arange(n), SPANS)]
    errors = np.array([FLOOR * level.steps[name] for name in level.names])
    for clusters in (np.arange(n)[:, None], [fold.predicted for fold in level.folds], spans):
        sums = np.array([g[views].sum(0) for views in clusters])
        K = len(sums)
        variances = np.diag(inverse @ (sums.T @ sums) @ inverse) * K / (K - 1)
        errors = np.maximum(errors, np.sqrt(variances))
    return np.where(np.diag(matrix @ inverse) > 0.5, errors, np.inf)  # a number without effect is not known


def _axis(level, zero):
    """The shift along u with the smallest differences, mm, and whether trials on both sides of it have larger ones."""
    width, costs = level.scan.geometry.sDetector[1], {}

    def cost(k):
        if k not in costs:
            try:
                r = level.differences(zero | {'u': k * TRIAL * width})
            except InputError:  # no ray meets the volume, so nothing is predicted
                r = level.scan.projections
            costs[k] = np.square(r, dtype=float).sum()
        return costs[k]

    reach, farthest = round(REACH / TRIAL), round(FARTHEST / TRIAL)
    best = min(range(-reach, reach + 1), key=cost)
    if abs(best) == reach or costs[best] > CLEAR * max(costs.values()):
        best = min(range(-farthest, farthest + 1), key=cost)
    return best * TRIAL * width, abs(best) < farthest
