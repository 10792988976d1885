"""What a scan says of itself: numbers with their units, and what to correct."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lingo_mi.geometry.base import CircularGeometry
from lingo_mi.inspection.consistency import Plane, best_shift, disagreement, swapped
from lingo_mi.inspection.jitter import outline_jitter
from lingo_mi.raw.line_integrals import photons_of_images
from lingo_mi.scan import Scan

COLUMNS = 128  # of the plane: enough for a tenth of a pixel, few for all pairs
VIEWS = 40  # of the plane: the time goes with its square
CLEAR = 0.01  # a disagreement that is more than discretisation
UNSTEADY = 0.5  # pixels of jitter that blur a volume
UNEQUAL_AIR = 0.01  # relative to the highest line integral
HALF_TURN = 175  # degrees: views of less do not tell the axis
WIDE = 2  # half a panel over its distance from the source, which no panel has
UNEQUAL = 0.03  # relative deviation of the masses of parallel views that is no discretisation


@dataclass
class Findings:
    """What `look` has measured.

    facts      sentences with numbers
    advice     sentences: what to correct, and how; empty for a sound scan
    air        level beside the object, nan where none is seen
    mass       [n] mean line integral of every view, air subtracted
    suspects   views that are black, doubled or out of order
    misplaced  whether advice says that angles or distances are wrong
    """

    facts: list[str] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)
    air: float = np.nan
    mass: np.ndarray = field(default_factory=lambda: np.zeros(0))
    suspects: list[int] = field(default_factory=list)
    misplaced: bool = False

    def misplace(self, advice: str) -> None:
        self.advice.append(advice)
        self.misplaced = True


def look(scan: Scan) -> Findings:
    """Measures a scan; nothing is changed."""
    found = Findings()
    geometry, p = scan.geometry, scan.projections
    n, (nv, nu) = len(scan), geometry.nDetector
    valid = np.ones(p.shape, bool) if scan.valid is None else scan.valid
    found.facts.append(
        f'{n} views of {nv} x {nu} pixels of {geometry.dDetector[0]:.4g} x {geometry.dDetector[1]:.4g} mm, {geometry.mode} beam'
        + (f', DSO {geometry.DSO:.5g} mm, DSD {geometry.DSD:.5g} mm' if geometry.mode == 'cone' else '')
        + f'; {1 - valid.mean():.2%} of the pixels are left out'
    )
    top = float(np.percentile(p[valid], 99.5))
    if -np.percentile(p[valid], 0.5) > 2 * max(top, 0):
        found.advice.append(
            'line integrals are negative: they look like ln(I / I0) (give -ln(I / I0)), or the flats had less exposure than the '
            'views (import with --exposure, or --air)'
        )
    _air_and_truncation(found, p, valid, top)
    photons = photons_of_images(p, scan.valid)
    if np.isfinite(photons) and photons < 1e8:
        found.facts.append(
            f'noise: {photons**-0.5:.2g} rms in air from column to column, as of {photons:.2g} photons a pixel'
        )
    else:
        found.facts.append('noise: none that could be measured')
    highest = float(p[valid].max())
    clipped = float((p[valid] == highest).mean())
    if clipped > 1e-3 and clipped * valid.sum() > 2 * n and highest > 0:
        found.facts.append(f'saturation: {clipped:.2%} of the pixels have exactly the highest value, {highest:.3g}')
        found.advice.append(
            'pixels are clipped at the highest value: mark them in the mask `valid` (photon starvation)'
        )
    air = 0.0 if np.isnan(found.air) else found.air
    found.mass = np.array([(p[i][valid[i]].mean() - air) if valid[i].any() else 0.0 for i in range(n)])
    _views(found, p - air, valid)
    _masses(found, scan, valid)
    _jitter(found, scan, air)
    _angles(found, scan, air)
    return found


def _air_and_truncation(found, p, valid, top):
    nu = p.shape[2]
    edge = max(1, nu // 64)
    sides = np.concatenate([p[:, :, :edge][valid[:, :, :edge]], p[:, :, -edge:][valid[:, :, -edge:]]])
    if not sides.size:
        return
    low = np.percentile(sides, 5)
    near = sides[sides <= low + 0.1 * (top - low)]
    even = low < 0.5 * top and near.size > 0.9 * sides.size  # all around: air, but not at 0
    if low > 0.2 * top and not even:
        found.facts.append('air: none beside the object, which fills the panel')
    else:
        found.air = float(np.median(near))
        found.facts.append(f'air: {found.air:.4g} beside the object (line integral; 0 without error)')
        if abs(found.air) > 0.01 * top:
            found.advice.append(
                f'air is {found.air:.3g} instead of 0: import again with --air, or subtract it from the projections'
            )
        _air_of_views(found, p, valid, edge, low, top)
    limit = (0.0 if np.isnan(found.air) else found.air) + 0.1 * top
    cut = {}
    for name, part in (('left or right', np.s_[:, :, [0, -1]]), ('upper or lower', np.s_[:, [0, -1], :])):
        inside = (p[part] > limit) & valid[part]
        cut[name] = int(inside.any((1, 2)).sum())
    if p.shape[1] < 3:
        cut.pop('upper or lower')
    for name, views in cut.items():
        if views:
            found.facts.append(f'truncation: the object reaches over the {name} edge of the panel in {views} views')
            found.advice.append(
                f'{name} edge: fit with -D outside=ignore, and make the volume (nVoxel) hold the object'
            )


def _air_of_views(found, p, valid, edge, low, top):
    """How much the air level of the views differs."""
    near = np.concatenate([p[:, :, :edge], p[:, :, -edge:]], 2)
    near = np.where(np.concatenate([valid[:, :, :edge], valid[:, :, -edge:]], 2), near, np.inf).reshape(len(p), -1)
    levels = [
        np.median(view[view < low + 0.1 * (top - low)]) for view in near if (view < low + 0.1 * (top - low)).sum() > 8
    ]
    if len(levels) < len(p) / 2:
        return
    spread = float(np.std(levels))
    found.facts.append(f'air of the views: differs by {spread:.2g} rms')
    if spread > UNEQUAL_AIR * top:
        found.advice.append(
            f'the air level of the views differs by {spread:.2g} rms: import again with --air, which scales every view by its '
            'own air, or fit with -D fit_air=view'
        )


def _views(found, p, valid):
    """Black and doubled views."""
    typical = np.median(found.mass)
    n = len(p)
    black = [
        i for i in range(n) if not valid[i].any() or np.ptp(p[i][valid[i]]) == 0 or abs(found.mass[i]) < 0.1 * typical
    ]
    if black:
        found.suspects += black
        found.advice.append(f'{_named(black)} black or empty: drop with --views of import, or lm.Scan.subset')
    if n >= 4:
        doubled = [i for i in range(1, n) if i not in black and i - 1 not in black and np.array_equal(p[i], p[i - 1])]
        if doubled:
            found.suspects += doubled
            found.advice.append(
                f'{_named(doubled)} the same as the one before: drop it, or correct the angles (a frame was stored twice)'
            )


def _masses(found, scan, valid):
    """The views of a parallel beam all have the object's mass."""
    mass = np.delete(found.mass, found.suspects)
    if scan.geometry.mode != 'parallel' or not valid.all() or len(mass) < 3 or not mass.mean() > 0:
        return
    if any(fact.startswith('truncation') for fact in found.facts):
        return
    spread = mass.std() / mass.mean()
    found.facts.append(f'mass: equal in all views to {spread:.2%} rms')
    if spread > UNEQUAL:
        found.advice.append(
            f'the mass of the views differs by {spread:.1%} rms: the beam or the exposure drifts; import again with --air, which '
            'scales every view by its own air'
        )


def _jitter(found, scan, air):
    """Unsteady motion along columns and rows."""
    if not isinstance(scan.geometry, CircularGeometry) or found.suspects or scan.valid is not None:
        return
    values = outline_jitter(scan.projections - air, scan.geometry.angles)
    known = [(x, name) for x, name in zip(values[::-1], ('rows', 'columns')) if np.isfinite(x)]
    if known:
        found.facts.append('jitter of the outline: ' + ', '.join(f'{x:.2g} pixels along {name}' for x, name in known))
    if any(x > UNSTEADY for x, _ in known):
        found.advice.append(
            'the object or the panel moves from view to view: fit with -D rate_pose=2e-3,2e-4, and keep it if the held-out views '
            'get better; of a slow drift lingo-mi calibrate --drift 3 tells the course'
        )


def _plane(scan, air):
    """The plane of the source, or a sentence why there is none."""
    geometry = scan.geometry
    if not isinstance(geometry, CircularGeometry):
        return 'the scanner leaves the circle'
    (nv, nu), (dv, du) = geometry.nDetector, geometry.dDetector
    p = scan.projections.astype(float) - air
    valid = np.ones(p.shape, bool) if scan.valid is None else scan.valid
    if geometry.mode == 'parallel':
        known: np.ndarray = np.any(valid, axis=1)
        row = (p * valid).sum(1) / np.maximum(valid.sum(1), 1)
    else:
        middle = nv / 2 - 0.5 + geometry.offDetector[0] / dv
        if not -0.5 <= middle <= nv - 0.5:
            return 'the panel does not see the plane of the source'
        first = min(max(int(np.floor(middle)), 0), nv - 1)
        last = min(first + 1, nv - 1)
        part = min(max(middle - first, 0.0), 1.0)
        row, known = (1 - part) * p[:, first] + part * p[:, last], valid[:, first] & valid[:, last]
    if (~known[:, :-1] & ~known[:, 1:]).any():  # a gap that a mean of neighbours does not fill
        return 'pixels side by side in the plane of the source are not valid'
    row = np.stack([_bridged(*line) for line in zip(row, known)])
    by = max(1, nu // COLUMNS)
    columns = nu // by
    row = row[:, : columns * by].reshape(len(p), columns, by).mean(2)
    u = (np.arange(columns) + 0.5) * by * du - nu * du / 2 + geometry.offDetector[1]
    peak = np.percentile(row, 99.5)
    if row[:, [0, -1]].max() > 0.15 * peak:
        return 'the object reaches over the edge of the panel'
    return Plane(row, geometry.angles, u, geometry.DSD if geometry.mode == 'cone' else 0.0)


def _bridged(values, known):
    """A row with what is not known interpolated between its neighbours."""
    place = np.arange(len(values))
    return values if known.all() or not known.any() else np.interp(place, place[known], values[known])


def _angles(found, scan, air):
    """Unit and sense of the angles, the axis, and views out of order."""
    geometry, n = scan.geometry, len(scan)
    turn = 0.0
    if geometry.mode == 'cone' and max(geometry.sDetector) > 2 * WIDE * geometry.DSD:
        found.misplace(
            f'the panel of {max(geometry.sDetector):.4g} mm is {max(geometry.sDetector) / geometry.DSD:.2g} times as wide as its '
            'distance from the source: give DSO, DSD and the size of the pixels in mm'
        )
    if n >= 2 and isinstance(geometry, CircularGeometry):
        span = np.ptp(geometry.angles)
        if span <= 2 * np.pi:  # those of poses jump from pi to -pi
            span = min(span, np.ptp(np.unwrap(geometry.angles)))
        turn = span * n / (n - 1)
        if not turn:
            found.misplace('all views have the same angle: give the angle of each')
            return
    if n >= 4 and isinstance(geometry, CircularGeometry):
        found.facts.append(f'angles: {np.degrees(turn):.4g} degrees in all')
        for whole in (np.pi, 2 * np.pi):
            if abs(np.degrees(turn) / whole - 1) < 0.02:
                found.misplace(
                    f'the angles span {np.degrees(turn):.3g} degrees: they look like radians; a .yml takes degrees'
                )
                return
            if abs(turn / np.degrees(whole) - 1) < 0.02:
                found.misplace(
                    f'the angles span {turn:.4g} radians: they look like degrees; give numpy.radians(angles)'
                )
                return
    plane = _plane(scan, air)
    if isinstance(plane, str):
        found.facts.append(
            f'consistency of the views: not measured, as {plane}; lingo-mi calibrate finds an axis off centre all the same'
        )
        return
    index = np.array([i for i in range(n) if i not in found.suspects], int)
    if len(index) < 2:
        found.facts.append('consistency of the views: not measured, as too few of them show anything')
        return
    index = index[:: max(1, -(-len(index) // VIEWS))]
    plane = plane.subset(index)
    shift, best = best_shift(plane, plane.angles, 0.08 * np.ptp(plane.u))
    given = disagreement(plane, plane.angles)[0]
    if not np.isfinite(given) or not np.isfinite(best):
        found.facts.append('consistency of the views: not measured, as too few of them see the object from beside')
        return
    what = 'of the half-width of the panel' if not plane.DSD else 'of their mass'
    found.facts.append(f'consistency of the views: they disagree by {given:.2%} rms {what}')
    _, other = best_shift(plane, -plane.angles, 0.08 * np.ptp(plane.u)) if plane.DSD else (0.0, np.inf)
    if best > CLEAR and other < 0.4 * best:
        found.misplace(
            f'with reversed angles the views disagree by {other:.2%} instead of {best:.2%}: change the sign of the angles, or '
            'mirror the columns'
        )
        return
    pair = swapped(plane, plane.angles, shift) if best > 0.2 * CLEAR else None
    if pair is not None:
        views = [int(index[i]) for i in pair]
        found.suspects += views
        found.advice.append(
            f"views {views[0]} and {views[1]} fit better in each other's place: check the order of the frames"
        )
        return
    if np.degrees(turn) < HALF_TURN:
        found.facts.append('axis: not measured, as the views span less than half a turn')
        return
    pixel = geometry.dDetector[1]
    if abs(shift) > 0.5 * pixel and best < 0.7 * given:
        found.facts.append(
            f'axis: {shift:+.3g} mm on the panel ({shift / pixel:+.2g} pixels) lets them agree to {best:.2%}'
        )
        found.misplace(
            f'the axis is off: add {shift:+.3g} mm to the second number of offDetector, or run lingo-mi calibrate'
        )


def _named(views):
    text = ', '.join(map(str, views[:6])) + (', ...' if len(views) > 6 else '')
    return f'view {text} is' if len(views) == 1 else f'views {text} are'
