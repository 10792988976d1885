"""Measurements of a scan's errors, and which of them call for a correction. Nothing is changed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lingo_mi.geometry.circle import CircularGeometry
from lingo_mi.inspection.air import Air, steady
from lingo_mi.inspection.consistency import Plane, best_shift, disagreement, swapped
from lingo_mi.inspection.dead_columns import dead_columns
from lingo_mi.inspection.jitter import outline_jitter
from lingo_mi.inspection.text_order import text_order
from lingo_mi.raw.line_integrals import MOST_VIEWS, photons_of_images
from lingo_mi.scan import PIECE, Scan

COLUMNS = 128  # of the plane: enough for a tenth of a pixel, and few enough for all pairs
VIEWS = 40  # of the plane: the time grows with the square
CLEAR = 0.01  # a larger disagreement is more than discretisation
UNSTEADY = 0.5  # more pixels of jitter blur a volume
AIR_OFF = 0.01  # relative to the highest line integral
UNEQUAL_AIR = 0.01  # relative to the highest line integral
UNSTEADY_AIR = 0.002  # the same, if air is clear of the object in all views
BRIGHT, FLAT = 0.85, 0.25  # intensities of air: at least this part of the highest, and within this part of the contrast
DARK = 0.7  # part of the intensity of air: the object lies below
HALF_TURN = 175  # degrees: views over less do not tell the axis
WIDE = 2  # half a panel over its distance from the source: no panel has so much
# Pixels along the edge of the panel and across: their median is taken, because a noisy pixel is not the object.
BLOCK = (5, 3)
SURE = 6  # standard deviations above air: pixels beyond are the object
UNEQUAL = 0.03  # relative deviation of the masses of parallel views that discretisation does not explain


# Why the consistency of the views is not measured: the scanner leaves the circle, the panel does not see the plane of the source
# or has gaps there, the object reaches over its edge, too few views show anything, or too few see the object from the side.
Obstacle = Literal['orbit', 'panel', 'gaps', 'truncation', 'empty', 'aside']


@dataclass(frozen=True)
class Border:
    """Measurements of the pixels at the edges of the panel.

    Attributes
    ----------
    air : float or None
        Line integral beside the object, 0 in a scan without error; None if the object fills the panel.
    air_spread : float or None
        Standard deviation of the views' air levels, a line integral; None if too few views show air.
    cut_sides, cut_ends : int
        Number of views in which the object reaches over the left or right, and over the upper or lower edge.
    """

    air: float | None
    air_spread: float | None
    cut_sides: int
    cut_ends: int


@dataclass(frozen=True)
class Orbit:
    """Measurements of angles, order and axis from the views; the defaults stand for no measurement.

    Attributes
    ----------
    turn : float or None
        Radians from the first view to one after the last; 0 if all views have the same angle, None if they are not on a circle.
    unit : {'radians', 'degrees'} or None
        The unit that the angles seem to have instead of the right one.
    obstacle : Obstacle or None
        Why the numbers below are not measured.
    disagreement : float or None
        Root mean square disagreement of the views with the geometry of the scan: relative to their mass, or in a parallel beam
        to half the width of the panel.
    shift : float
        Shift of the axis on the panel along u, in mm, that lets the views agree best.
    shifted : float or None
        Disagreement with that shift.
    reversed : float or None
        Disagreement with that shift and reversed angles, if these fit much better.
    swapped : tuple of int, or None
        Two views that fit better in each other's place.
    off_axis : bool
        Whether the shift lets the views agree so much better that the axis is off.
    """

    turn: float | None = None
    unit: Literal['radians', 'degrees'] | None = None
    obstacle: Obstacle | None = None
    disagreement: float | None = None
    shift: float = 0.0
    shifted: float | None = None
    reversed: float | None = None
    swapped: tuple[int, int] | None = None
    off_axis: bool = False

    @property
    def short(self) -> bool:
        """True if the views span too little to measure the axis."""
        return self.turn is not None and np.degrees(self.turn) < HALF_TURN


@dataclass(frozen=True)
class Findings:
    """Result of `measure`.

    Attributes
    ----------
    invalid : float
        Share of the pixels that are left out.
    high, highest : float
        99.5th percentile and maximum of the line integrals.
    negative : bool
        Whether the line integrals look like ln(I / I0) instead of ln(I0 / I).
    intensities : float or None
        The intensity beside the object, if they look like intensities: see `open_beam`.
    border : Border or None
        None if no pixel at the left or right edge is valid.
    air : Air or None
        The air level of the views, if it can be read and is not 0; what follows is measured without it.
    photons : float or None
        Photons of a pixel in air, from the noise; None without noise.
    clipped : float or None
        Share of the pixels that have exactly the highest value; None if there are few.
    mass : ndarray of shape (n,)
        Mean line integral of every view, air subtracted.
    mass_spread : float or None
        Relative standard deviation of the masses of the views of a parallel beam; None if they need not be equal.
    text_order : ndarray of shape (n,), or None
        The place of every view in the order of the numbers, if the views were sorted as text; all other numbers about views use
        this order. None if they were not.
    dead_columns : list of int
        Columns that show the same in all views; they are left out of what follows.
    black, doubled : list of int
        Views without an object, and views equal to the one before.
    jitter : tuple of float
        Standard deviation of the outline's place from view to view, in pixels along rows and columns; nan if not measured.
    wide : float or None
        Width of the panel over its distance from the source, if that is too wide.
    orbit : Orbit
        Angles, order and axis.
    """

    invalid: float
    high: float
    highest: float
    negative: bool
    intensities: float | None
    border: Border | None
    air: Air | None
    photons: float | None
    clipped: float | None
    mass: np.ndarray
    mass_spread: float | None
    text_order: np.ndarray | None
    dead_columns: list[int]
    black: list[int]
    doubled: list[int]
    jitter: tuple[float, float]
    wide: float | None
    orbit: Orbit

    @property
    def suspects(self) -> list[int]:
        """Views that are black, doubled or out of order."""
        return [*self.black, *self.doubled, *(self.orbit.swapped or ())]

    @property
    def misplaced(self) -> bool:
        """True if angles, order or distances are wrong."""
        o = self.orbit
        return bool(
            self.text_order is not None or self.wide or o.turn == 0 or o.unit or o.reversed is not None or o.off_axis
        )

    @property
    def air_is_off(self) -> bool:
        air = self.border and self.border.air
        return air is not None and abs(air) > AIR_OFF * self.high

    @property
    def air_differs(self) -> bool:
        """True if the views have different air levels, or air that slopes differently."""
        if self.air is not None and self.air.levels.std(0).max() > UNSTEADY_AIR * self.high:
            return True
        spread = self.border and self.border.air_spread
        return spread is not None and spread > UNEQUAL_AIR * self.high

    @property
    def mass_differs(self) -> bool:
        return self.mass_spread is not None and self.mass_spread > UNEQUAL

    @property
    def unsteady(self) -> bool:
        """True if the object or the panel moves from view to view."""
        return any(x > UNSTEADY for x in self.jitter)


def measure(scan: Scan) -> Findings:
    """Measure what a scan says of air, noise, truncation, order, angles and axis.

    Parameters
    ----------
    scan : Scan
        Line integrals [view, v, u].

    Returns
    -------
    Findings
        Numbers, and what they say about the scan.

    Examples
    --------
    >>> measure(scan).orbit.off_axis
    False
    """
    valid = np.ones(scan.projections.shape, bool) if scan.valid is None else scan.valid
    invalid, place, dead = float(1 - valid.mean()), text_order(scan), dead_columns(scan)
    if place is not None:
        scan = _at(scan, place)
    if dead:
        scan = _without(scan, dead)
    p = scan.projections
    valid = np.ones(p.shape, bool) if scan.valid is None else scan.valid
    high, highest = float(np.percentile(p[valid], 99.5)), float(p[valid].max())
    border = _border(p, valid, high)
    original, (scan, level) = scan, steady(scan)
    p, air = scan.projections, 0.0 if level else (border and border.air) or 0.0
    intensities = open_beam(original)
    photons = np.inf if intensities is not None else photons_of_images(p, scan.valid)
    clipped = float((original.projections[valid] == highest).mean())
    many = clipped > 1e-3 and clipped * valid.sum() > 2 * len(scan) and highest > 0
    mass = np.array([(view[mask].mean() - air) if mask.any() else 0.0 for view, mask in zip(p, valid)])
    black, doubled = _black_and_doubled(p - air, valid, mass)
    suspects = [*black, *doubled]
    truncated = border is not None and (border.cut_sides or border.cut_ends)
    return Findings(
        invalid=invalid,
        high=high,
        highest=highest,
        negative=bool(-np.percentile(original.projections[valid], 0.5) > 2 * max(high, 0)),
        intensities=intensities,
        border=border,
        air=level,
        photons=photons if np.isfinite(photons) and photons < 1e8 else None,
        clipped=clipped if many else None,
        mass=mass,
        mass_spread=None if truncated else _mass_spread(scan, np.delete(mass, suspects)),
        text_order=place,
        dead_columns=dead,
        black=black,
        doubled=doubled,
        jitter=(np.nan, np.nan) if suspects else _jitter(scan, air),
        wide=_too_wide(scan),
        orbit=_orbit(scan, air, suspects),
    )


def _at(scan, place):
    """The scan with its views moved to these places."""
    index = np.argsort(place)
    valid = None if scan.valid is None else scan.valid[index]
    return replace(scan, projections=scan.projections[index], valid=valid)


def _without(scan, columns):
    valid = np.ones(scan.projections.shape, bool) if scan.valid is None else scan.valid.copy()
    valid[:, :, columns] = False
    return replace(scan, valid=valid)


def intensity_warning(I0: float) -> str:
    """The message about projections that are intensities, `I0` beside the object."""
    return (
        'these look like intensities, not line integrals: values are highest, and alike, at the edges of the panel; write '
        f'input: intensity and I0: {I0:.4g} into the geometry file (.yml), import the frames with lingo-mi import, or give '
        f'-numpy.log(I / {I0:.4g})'
    )


def warn_of_intensities(scan: Scan) -> None:
    """Warn if the projections of a scan look like intensities."""
    if (I0 := open_beam(scan)) is not None:
        warnings.warn(intensity_warning(I0), stacklevel=3)


def open_beam(scan: Scan) -> float | None:
    """The intensity beside the object, or None if projections do not look like intensities.

    Intensities are highest, and alike, at the left and right edge of the panel. At most 64 views are examined, of stored ones 16.
    """
    most = MOST_VIEWS if scan.stored is None else PIECE
    if len(scan) > most:
        scan = scan.subset(np.arange(most) * len(scan) // most)
    p, edge = scan.views(slice(None)), max(1, scan.geometry.nDetector[1] // 64)
    valid = np.ones(p.shape, bool) if scan.valid is None else scan.valid
    sides = np.concatenate([p[:, :, part][valid[:, :, part]] for part in (slice(0, edge), slice(-edge, None))])
    if not sides.size:
        return None
    low, high = np.percentile(p[valid], [1, 99])
    air, spread = np.median(sides), np.ptp(np.percentile(sides, [5, 95]))
    alike = air > 0 and low > -0.05 * air and low < DARK * air and air > BRIGHT * high and spread < FLAT * (air - low)
    return float(air) if alike else None


def _border(p, valid, high):
    p = np.where(valid, p, np.nan)
    ends = _outer(np.swapaxes(p, 1, 2)) if p.shape[1] >= 3 else None
    sides = _outer(p)
    values = sides[np.isfinite(sides)]
    if not values.size:
        return None
    low = np.percentile(values, 5)
    near = values[values <= low + 0.1 * (high - low)]
    even = low < 0.5 * high and near.size > 0.9 * values.size  # air all around, but not at 0
    air = spread = None
    if low <= 0.2 * high or even:
        air = float(np.median(near))
        spread = _air_spread(p, low + 0.1 * (high - low))
    return Border(
        air, spread, *(0 if x is None else int(_reaches(x, air or 0.0, 0.1 * high).sum()) for x in (sides, ends))
    )


def _outer(p):
    """Medians of `BLOCK` pixels at the left and right edge of the views, [view, row, side], NaN if none is valid."""
    long, deep = (min(size, have) for size, have in zip(BLOCK, p.shape[1:]))
    edges = np.stack([p[:, :, :deep], p[:, :, -deep:]], 2)[:, : p.shape[1] // long * long]
    blocks = edges.reshape(len(p), -1, long, 2, deep).swapaxes(2, 3).reshape(len(p), -1, 2, long * deep)
    return _medians(blocks)


def _medians(blocks):
    """Along the last axis, of what is not NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)  # from blocks of NaN alone
        return np.nanmedian(blocks, -1)


def _reaches(outer, air, limit):
    """In which views an edge, `_outer`, is higher than air by the limit and by the noise, bool [view]."""
    steps = np.abs(np.diff(outer, axis=1 if outer.shape[1] > 1 else 0))
    noise = np.median(steps[np.isfinite(steps)]) / 0.954 if np.isfinite(steps).any() else 0.0  # 0.954: of a Gaussian
    return (outer > air + max(limit, SURE * noise)).any((1, 2))


def _air_spread(p, limit):
    """Standard deviation of the views' air levels, without noise. A level is the mean of the pixels near the sides that are
    below the limit."""
    edge = max(1, p.shape[2] // 64)
    near = np.concatenate([p[:, :, :edge], p[:, :, -edge:]], 2).reshape(len(p), -1)
    air = [air_values for view in near if (air_values := view[view < limit]).size > 8]
    if len(air) < len(p) / 2:
        return None
    noise = np.mean([np.pi / 2 * view.var() / view.size for view in air])  # of a median
    return float(np.sqrt(max(np.var([np.median(view) for view in air]) - noise, 0.0)))


def _black_and_doubled(p, valid, mass):
    n, typical = len(p), np.median(mass)
    black = [i for i in range(n) if not valid[i].any() or np.ptp(p[i][valid[i]]) == 0 or abs(mass[i]) < 0.1 * typical]
    doubled = []
    if n >= 4:
        doubled = [i for i in range(1, n) if i not in black and i - 1 not in black and np.array_equal(p[i], p[i - 1])]
    return black, doubled


def _mass_spread(scan, mass):
    """The views of a parallel beam all have the object's mass."""
    if scan.geometry.mode != 'parallel' or scan.valid is not None or len(mass) < 3 or not mass.mean() > 0:
        return None
    return float(mass.std() / mass.mean())


def _jitter(scan, air):
    if not isinstance(scan.geometry, CircularGeometry) or scan.valid is not None:
        return np.nan, np.nan
    columns, rows = outline_jitter(scan.projections - air, scan.geometry.angles)
    return rows, columns


def _too_wide(scan):
    geometry = scan.geometry
    ratio = max(geometry.sDetector) / geometry.DSD if geometry.mode == 'cone' else 0.0
    return ratio if ratio > 2 * WIDE else None


def _plane(scan: Scan, air: float) -> Plane | Obstacle:
    """The plane of the source, or why there is none."""
    geometry = scan.geometry
    if not isinstance(geometry, CircularGeometry):
        return 'orbit'
    (nv, nu), (dv, du) = geometry.nDetector, geometry.dDetector
    p = scan.projections.astype(float) - air
    valid = np.ones(p.shape, bool) if scan.valid is None else scan.valid
    if geometry.mode == 'parallel':
        valid_pixels: np.ndarray = np.any(valid, axis=1)
        row = (p * valid).sum(1) / np.maximum(valid.sum(1), 1)
    else:
        middle = nv / 2 - 0.5 + geometry.offDetector[0] / dv
        if not -0.5 <= middle <= nv - 0.5:
            return 'panel'
        first = min(max(int(np.floor(middle)), 0), nv - 1)
        last = min(first + 1, nv - 1)
        part = min(max(middle - first, 0.0), 1.0)
        row, valid_pixels = (1 - part) * p[:, first] + part * p[:, last], valid[:, first] & valid[:, last]
    if (~valid_pixels[:, :-1] & ~valid_pixels[:, 1:]).any():  # a gap that a mean of neighbours does not fill
        return 'gaps'
    row = np.stack([_bridged(*line) for line in zip(row, valid_pixels)])
    by = max(1, nu // COLUMNS)
    columns = nu // by
    row = row[:, : columns * by].reshape(len(p), columns, by).mean(2)
    u = (np.arange(columns) + 0.5) * by * du - nu * du / 2 + geometry.offDetector[1]
    peak = np.percentile(row, 99.5)
    if _reaches(_outer(row[:, None]), 0.0, 0.15 * peak).any():
        return 'truncation'
    return Plane(row, geometry.angles, u, geometry.DSD if geometry.mode == 'cone' else 0.0)


def _bridged(values, valid):
    """A row whose invalid pixels are interpolated between their neighbours."""
    place = np.arange(len(values))
    return values if valid.all() or not valid.any() else np.interp(place, place[valid], values[valid])


def _orbit(scan, air, suspects):
    """Unit and sense of the angles, the axis, and views out of order."""
    geometry, n = scan.geometry, len(scan)
    turn = _turn(geometry) if n >= 2 and isinstance(geometry, CircularGeometry) else None
    if turn == 0:
        return Orbit(turn)
    if turn is not None and n >= 4:
        for whole in (np.pi, 2 * np.pi):
            if abs(np.degrees(turn) / whole - 1) < 0.02:
                return Orbit(turn, 'radians')
            if abs(turn / np.degrees(whole) - 1) < 0.02:
                return Orbit(turn, 'degrees')
    plane = _plane(scan, air)
    if isinstance(plane, str):
        return Orbit(turn, obstacle=plane)
    index = np.array([i for i in range(n) if i not in suspects], int)
    if len(index) < 2:
        return Orbit(turn, obstacle='empty')
    index = index[:: max(1, -(-len(index) // VIEWS))]
    plane = plane.subset(index)
    reach = 0.08 * np.ptp(plane.u)
    shift, best = best_shift(plane, plane.angles, reach)
    unshifted = disagreement(plane, plane.angles)[0]
    if not np.isfinite(unshifted) or not np.isfinite(best):
        return Orbit(turn, obstacle='aside')
    orbit = Orbit(turn, disagreement=unshifted, shift=shift, shifted=best)
    _, other = best_shift(plane, -plane.angles, reach) if plane.DSD else (0.0, np.inf)
    if best > CLEAR and other < 0.4 * best:
        return replace(orbit, reversed=other)
    pair = swapped(plane, plane.angles, shift) if best > 0.2 * CLEAR else None
    if pair is not None:
        return replace(orbit, swapped=(int(index[pair[0]]), int(index[pair[1]])))
    pixel = geometry.dDetector[1]
    return replace(orbit, off_axis=not orbit.short and abs(shift) > 0.5 * pixel and best < 0.7 * unshifted)


def _turn(geometry):
    """Radians from the first view to one after the last."""
    span = np.ptp(geometry.angles)
    if span <= 2 * np.pi:  # angles of poses jump from pi to -pi
        span = min(span, np.ptp(np.unwrap(geometry.angles)))
    return float(span * len(geometry) / (len(geometry) - 1))
