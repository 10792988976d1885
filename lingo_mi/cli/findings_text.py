"""The text of `lingo-mi inspect`: findings as sentences, and the option that corrects each."""

from __future__ import annotations

import numpy as np

from lingo_mi.inspection.measure import Findings, intensity_warning
from lingo_mi.scan import Scan

CALIBRATE = '; lingo-mi calibrate finds an axis off centre all the same'
OBSTACLES = dict(
    orbit='the scanner leaves the circle' + CALIBRATE,
    panel='the panel does not see the plane of the source' + CALIBRATE,
    gaps='pixels side by side in the plane of the source are not valid' + CALIBRATE,
    truncation='the object reaches over the edge of the panel' + CALIBRATE,
    empty='too few of them show anything',
    aside='too few of them see the object from the side',
)


def facts(scan: Scan, findings: Findings) -> list[str]:
    """Sentences with the numbers that were measured."""
    geometry = scan.geometry
    (nv, nu), (dv, du) = geometry.nDetector, geometry.dDetector
    lengths = f', DSO {geometry.DSO:.5g} mm, DSD {geometry.DSD:.5g} mm' if geometry.mode == 'cone' else ''
    lines = [
        f'{len(scan)} views of {nv} x {nu} pixels of {dv:.4g} x {du:.4g} mm, {geometry.mode} beam{lengths}; '
        f'{findings.invalid:.2%} of the pixels are left out'
    ]
    if findings.intensities is not None:
        return lines
    if (border := findings.border) is not None:
        if border.air is None:
            lines.append('air: none beside the object, which fills the panel')
        else:
            lines.append(f'air: {border.air:.4g} beside the object (line integral; 0 without error)')
        if (spread := _air_spread(findings)) is not None:
            lines.append(f'air of the views: differs by {spread:.2g} rms')
        for name, views in _cut(findings):
            lines.append(f'truncation: the object reaches over the {name} edge of the panel in {views} views')
    if findings.photons is None:
        lines.append('noise: none that could be measured')
    else:
        lines.append(
            f'noise: {findings.photons**-0.5:.2g} rms in air from column to column, like that of {findings.photons:.2g} '
            'photons a pixel'
        )
    if findings.clipped is not None:
        lines.append(
            f'saturation: {findings.clipped:.2%} of the pixels have exactly the highest value, {findings.highest:.3g}'
        )
    if findings.mass_spread is not None:
        lines.append(f'mass: equal in all views to {findings.mass_spread:.2%} rms')
    jitter = [f'{x:.2g} pixels along {name}' for x, name in zip(findings.jitter, ('rows', 'columns')) if np.isfinite(x)]
    if jitter:
        lines.append('jitter of the outline: ' + ', '.join(jitter))
    return lines + _orbit(scan, findings)


def _orbit(scan, findings):
    orbit, lines = findings.orbit, []
    if orbit.turn and len(scan) >= 4:
        lines.append(f'angles: {np.degrees(orbit.turn):.4g} degrees in all')
    if orbit.obstacle is not None:
        lines.append(f'consistency of the views: not measured, because {OBSTACLES[orbit.obstacle]}')
    if orbit.disagreement is None:
        return lines
    what = 'of the half-width of the panel' if scan.geometry.mode == 'parallel' else 'of their mass'
    lines.append(f'consistency of the views: they disagree by {orbit.disagreement:.2%} rms {what}')
    if orbit.off_axis:
        pixels = orbit.shift / scan.geometry.dDetector[1]
        lines.append(
            f'axis: {orbit.shift:+.3g} mm on the panel ({pixels:+.2g} pixels) lets them agree to {orbit.shifted:.2%}'
        )
    elif orbit.short and orbit.reversed is None and orbit.swapped is None:
        lines.append('axis: not measured, because the views span less than half a turn')
    return lines


def advice(scan: Scan, findings: Findings) -> list[str]:
    """Sentences that say what to correct, and how; none for a sound scan."""
    border, lines = findings.border, []
    if findings.text_order is not None:
        lines.append(
            'the views are sorted by their names as text, 10 before 2: sort them by number, as lingo-mi import does with frames; '
            'the findings about views hold for the order by text'
        )
    if findings.dead_columns:
        lines.append(
            f'{_named(findings.dead_columns, "column")} dead, the same in all views: mark in the mask `valid`, as lingo-mi '
            'import does with flat fields'
        )
    if findings.intensities is not None:
        return [*lines, intensity_warning(findings.intensities)]
    if findings.negative:
        lines.append(
            'line integrals are negative: they look like ln(I / I0) (give -ln(I / I0)), or the flats had less exposure than the '
            'views (import with --exposure, or --air)'
        )
    if border is not None:
        if findings.air_is_off:
            calibrated = '' if findings.air is None else ', or take it out with lingo-mi calibrate SCAN --out F.npy'
            lines.append(f'air is {border.air:.3g} instead of 0: import again with --air{calibrated}')
        if findings.air_differs:
            lines.append(
                f'the air level of the views differs by {_air_spread(findings):.2g} rms: import again with --air, which scales '
                f'every view by its own air, fit with -D fit_air=view, or {_calibrated(findings)}'
            )
        for name, _ in _cut(findings):
            lines.append(
                f'{name} edge: make the volume (nVoxel) hold the object; fit --method lingo also needs -D outside=ignore'
            )
    if findings.clipped is not None:
        lines.append('pixels are clipped at the highest value: mark them in the mask `valid` (photon starvation)')
    if findings.black:
        lines.append(f'{_named(findings.black)} black or empty: drop by --views of import, or by lm.Scan.subset')
    if findings.doubled:
        lines.append(
            f'{_named(findings.doubled)} the same as the one before: drop it, or correct the angles (a frame was stored twice)'
        )
    if findings.mass_differs:
        lines.append(
            f'the mass of the views differs by {findings.mass_spread:.1%} rms: the beam or the exposure drifts; import again '
            'with --air, which scales every view by its own air'
        )
    if findings.unsteady:
        lines.append(
            'the object or the panel moves from view to view: fit with -D rate_pose=2e-3,2e-4, and keep it if the held-out views '
            'get better; lingo-mi calibrate --drift 3 measures a slow drift'
        )
    return lines + _placement(scan, findings)


def _placement(scan, findings):
    """List the corrections of the geometry."""
    orbit, lines = findings.orbit, []
    if findings.wide:
        lines.append(
            f'the panel of {max(scan.geometry.sDetector):.4g} mm is {findings.wide:.2g} times as wide as its distance from the '
            'source: give DSO, DSD and the size of the pixels in mm'
        )
    if orbit.turn == 0:
        lines.append('all views have the same angle: give the angle of each')
    elif orbit.unit == 'radians':
        lines.append(
            f'the angles span {np.degrees(orbit.turn):.3g} degrees: they look like radians; a .yml takes degrees'
        )
    elif orbit.unit == 'degrees':
        lines.append(f'the angles span {orbit.turn:.4g} radians: they look like degrees; give numpy.radians(angles)')
    elif orbit.reversed is not None:
        lines.append(
            f'with reversed angles the views disagree by {orbit.reversed:.2%} instead of {orbit.shifted:.2%}: change the sign of '
            'the angles, or mirror the columns'
        )
    elif orbit.swapped is not None:
        first, second = orbit.swapped
        lines.append(f"views {first} and {second} fit better in each other's place: check the order of the frames")
    elif orbit.off_axis:
        lines.append(
            f'the axis is off: add {orbit.shift:+.3g} mm to the second number of offDetector, or run lingo-mi calibrate'
        )
    return lines


def _air_spread(findings):
    """Standard deviation of the air levels of the views; None if it is not known."""
    return findings.air.drift if findings.air is not None else findings.border.air_spread


def _calibrated(findings):
    """Say how `calibrate` removes a drift of the air level."""
    if findings.air is not None:
        return 'take it out with lingo-mi calibrate SCAN --out F.npy'
    return 'take out what is smooth in time with lingo-mi calibrate SCAN --air --out F.npy'


def _cut(findings):
    """The edges that the object reaches over, and in how many views."""
    sides = ('left or right', findings.border.cut_sides), ('upper or lower', findings.border.cut_ends)
    return [(name, views) for name, views in sides if views]


def _named(numbers, what='view'):
    text = ', '.join(map(str, numbers[:6])) + (', ...' if len(numbers) > 6 else '')
    return f'{what} {text} is' if len(numbers) == 1 else f'{what}s {text} are'
