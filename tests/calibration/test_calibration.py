"""Known errors of the panel's place are found, from sound, noisy and truncated scans; a sound scan is left as it is."""

from dataclasses import replace

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.calibration.calibration import Calibration
from lingo_mi.calibration.cross_prediction import coarse
from lingo_mi.calibration.drift import Drift, scan_times
from lingo_mi.calibration.panel import Panel
from lingo_mi.calibration.response.response import Response
from lingo_mi.calibration.search import SearchResult
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.geometry import circular
from lingo_mi.projectors import grid

PIXELS, SIZE = 72, 40


def scanner(views=20, rows=80, mode='cone', flat=False):
    phantom = lm.phantom('foot', SIZE)
    side = max(phantom.spacing) * SIZE
    sizes = dict(nDetector=(1 if flat else rows, PIXELS), nVoxel=SIZE, dVoxel=phantom.spacing, angles=circular(views))
    data = phantom.data
    if flat:
        sizes |= dict(nVoxel=(SIZE, SIZE, 1))
        data = data[:, :, SIZE // 2 : SIZE // 2 + 1]
    if mode == 'cone':
        return lm.Geometry.cone(DSO=4 * side, DSD=6 * side, dDetector=side * 2.2 / PIXELS, **sizes), data
    return lm.Geometry.parallel(dDetector=side * 1.4 / PIXELS, **sizes), data


def scanned(geometry, data, true):
    """Views through the real panel, with the nominal geometry."""
    return lm.Scan(geometry, grid.project_volume(data, true.moved(geometry)))


def in_pixels(calibration, name):
    return calibration.found.measured[name] / calibration.geometry.dDetector[name[0] == 'u']


@pytest.mark.parametrize(
    'true', [Panel(v=2.0), Panel(u=-3.0), Panel(yaw=0.1), Panel(np.array([1.0, -2, 3]), 2.0, -0.05)]
)
def test_moves_are_those_of_tigre(true):
    geometry, _ = scanner(3)
    v, u = (np.broadcast_to(x, 3) for x in (true.v, true.u))
    numbers = geometry.numbers() | dict(offDetector=np.stack([v, u], 1))
    expected = lm.Geometry.per_view(**numbers, rotDetector=(0, 0, true.yaw)).rays()
    moved = true.moved(geometry).rays()
    for name in ('source', 'corner', 'u', 'v'):
        np.testing.assert_allclose(getattr(moved, name), getattr(expected, name), atol=1e-9)


def test_axis_and_turn_of_the_panel():
    """They are found to a twentieth of a pixel and four hundredths of a degree."""
    geometry, data = scanner()
    pixel = geometry.dDetector[1]
    true = Panel(u=-2.4 * pixel, yaw=np.radians(0.8))
    scan = scanned(geometry, data, true)
    calibration = lm.calibrate(scan, progress=False)
    assert in_pixels(calibration, 'u') == pytest.approx(-2.4, abs=0.05)
    assert np.degrees(calibration.found.measured['yaw']) == pytest.approx(0.8, abs=0.04)
    assert calibration.found.after < 0.5 * calibration.found.before
    corner = true.moved(geometry).rays().corner
    before, after = (np.abs(s.geometry.rays().corner - corner).max() for s in (scan, calibration.corrected(scan)))
    assert after < 0.05 * before
    assert len(calibration.lines()) == 3 and all('not taken' not in line for line in calibration.lines())


@pytest.mark.thorough
def test_noisy_and_truncated():
    """The axis is found to a tenth of a pixel if the object is cut on both sides and above, and noise is 1 % of the highest
    value."""
    geometry, data = scanner(30)
    pixel = geometry.dDetector[1]
    scan = scanned(geometry, data, Panel(u=1.7 * pixel))
    cut = np.s_[:, 20:, 16:-16]
    shifted = replace(geometry, nDetector=(60, PIXELS - 32), offDetector=(-10 * geometry.dDetector[0], 0))
    p = scan.projections[cut]
    assert (p[:, :, [0, -1]] > 0.2 * p.max()).any() and (p[:, 0] > 0.2 * p.max()).any()
    p = p + np.random.default_rng(0).normal(0, 0.01 * p.max(), p.shape)
    calibration = lm.calibrate(lm.Scan(shifted, p), progress=False)
    assert in_pixels(calibration, 'u') == pytest.approx(1.7, abs=0.1)


def row_scan(mode, views, total, columns, stated=0.0, true=0.0, width=1.4):
    """One row of the foot. At the axis, the panel is `width` sides of the object wide; `stated` and `true` are offsets in
    columns."""
    phantom = lm.phantom('foot', SIZE)
    side = max(phantom.spacing) * SIZE
    data = phantom.data[:, :, SIZE // 2 : SIZE // 2 + 1]
    pixel = side * width / columns * (1.5 if mode == 'cone' else 1)
    sizes = dict(
        nDetector=(1, columns),
        dDetector=pixel,
        nVoxel=(SIZE, SIZE, 1),
        dVoxel=phantom.spacing,
        angles=circular(views, total),
        offDetector=(0, stated * pixel),
    )
    sizes |= dict(DSO=4 * side, DSD=6 * side) if mode == 'cone' else {}
    geometry = getattr(lm.Geometry, mode)(**sizes)
    return scanned(geometry, data, Panel(u=(true - stated) * pixel))


@pytest.mark.parametrize(
    ('mode', 'width', 'stated', 'true'),
    [
        pytest.param('parallel', 0.63, -20, -22, marks=pytest.mark.thorough),  # half a fan
        pytest.param('cone', 0.84, -20, -22, marks=pytest.mark.thorough),
        pytest.param('cone', 0.56, 0, 0, marks=pytest.mark.thorough),  # a region of interest
        ('cone', 0.56, 0, -2),
        ('parallel', 3.6, 0, 22),  # far off
    ],
)
def test_an_axis_of_objects_that_are_cut_and_one_far_off(mode, width, stated, true):
    """The axis is found to a twentieth of a pixel, and within three standard errors."""
    scan = row_scan(mode, 180, 360, 64, stated, true, width)
    calibration = lm.calibrate(scan, progress=False)
    right, pixel = true - stated, scan.geometry.dDetector[1]
    assert in_pixels(calibration, 'u') == pytest.approx(right, abs=0.05)
    assert abs(in_pixels(calibration, 'u') - right) < 3 * calibration.found.errors['u'] / pixel
    taken = calibration.found.drift.u[0] / pixel
    assert taken == (pytest.approx(right, abs=0.05) if right else 0)


@pytest.mark.thorough
def test_an_object_that_is_cut_turns_no_panel():
    """If the object is cut on both sides, a cone beam gives neither a shift nor a turn, and a line warns that no edge shows
    air."""
    geometry, data = scanner(24, rows=40)
    geometry = replace(geometry, nDetector=(32, 32))
    calibration = lm.calibrate(scanned(geometry, data, Panel()), progress=False)
    assert not calibration.needed and abs(in_pixels(calibration, 'u')) < 0.05
    assert any('no edge of the panel shows air' in line for line in calibration.lines())


@pytest.mark.parametrize('tilt', [pytest.param(0.0, marks=pytest.mark.thorough), 0.01])
def test_a_drift_of_the_beam_is_no_geometry(tilt):
    """A level that drifts by 4 % of the exposure, uniform or with slopes across the panel, is read beside the object and taken
    out."""
    geometry, data = scanner(24, rows=40)
    geometry = replace(geometry, dDetector=(geometry.dDetector[0] * 2, geometry.dDetector[1] * 2), nDetector=(40, 36))
    ideal = scanned(geometry, data, Panel())
    p = ideal.projections / ideal.projections.max()
    slope = 0.02 + tilt * np.linspace(-1, 1, 40)[:, None] + tilt * np.linspace(-1, 1, 36)
    scan = lm.Scan(geometry, p + np.linspace(-1, 1, 24)[:, None, None] * slope)
    calibration = lm.calibrate(scan, progress=False)
    drift = calibration.found.drift
    assert (drift.u[0], drift.yaw) == (0, 0) and abs(np.degrees(calibration.found.measured['yaw'])) < 0.03
    assert calibration.lines()[0].startswith('air beside the object: ') and calibration.needed
    np.testing.assert_allclose(calibration.corrected(scan).projections, p, atol=0.002)
    np.testing.assert_allclose(calibration.corrected(scan.subset([3, 9])).projections, p[[3, 9]], atol=0.002)


def test_drift_is_found_and_held_out_views_get_theirs():
    """A drift of 1.2 pixels from the first to the last view is found to a tenth of a pixel in every view."""
    geometry, data = scanner(40)
    pixel = geometry.dDetector[1]
    true = Drift.of(geometry, dict(u=0.8 * pixel, u1=0.6 * pixel, v1=-0.3 * pixel))
    every = scanned(geometry, data, true.panel(geometry))
    dataset = lm.Dataset(every.subset(slice(0, None, 2)), every.subset(slice(1, None, 2)))
    calibration = lm.calibrate(dataset, drift=1, progress=False)
    corrected = calibration.corrected(dataset)
    right = true.panel(geometry).moved(geometry).rays().corner
    for scan, part in ((corrected.train, slice(0, None, 2)), (corrected.test, slice(1, None, 2))):
        error = scan.geometry.rays().corner - right[part]
        error -= error.mean(0) * [0, 0, 1]  # the height is not told
        assert np.linalg.norm(error, axis=1).max() < 0.1 * pixel


@pytest.mark.thorough
def test_a_sound_scan_is_left_as_it_is():
    geometry, data = scanner(30)
    scan = scanned(geometry, data, Panel())
    calibration = lm.calibrate(scan, progress=False)
    assert not calibration.needed and calibration.corrected(scan) is scan
    assert all('not taken' in line for line in calibration.lines()[:-1])


@pytest.mark.parametrize('mode', ['cone', pytest.param('parallel', marks=pytest.mark.slow)])
def test_one_row(mode):
    geometry, data = scanner(40, mode=mode, flat=True)
    pixel = geometry.dDetector[1]
    calibration = lm.calibrate(scanned(geometry, data, Panel(u=3.3 * pixel)), progress=False)
    assert list(calibration.found.measured) == ['u']
    assert in_pixels(calibration, 'u') == pytest.approx(3.3, abs=0.05)


def responding(numbers, **parts):
    """Line integrals up to 2.5 as measured by a detector with these numbers, and as they are."""
    geometry, data = scanner()
    ideal = scanned(geometry, data, Panel())
    p = ideal.projections * (2.5 / ideal.projections.max())
    response = Response.of(geometry, highest=2.5, **parts).changed(numbers)
    return lm.Scan(geometry, response.applied(p, geometry)), p


@pytest.mark.thorough
def test_curve_of_the_detector():
    """If a fifth of the highest line integral is missing, three quarters of the error go, and a coefficient is found to
    0.03."""
    scan, p = responding({'curve0': -0.08}, curve=1)
    calibration = lm.calibrate(scan, curve=1, progress=False)
    assert calibration.found.measured['curve0'] == pytest.approx(-0.08, abs=0.03)
    assert np.std(calibration.corrected(scan).projections - p) < 0.3 * np.std(scan.projections - p)


@pytest.mark.thorough
def test_gain_over_time():
    """The polynomials of a gain that falls and rises by 4 % are found to 0.01."""
    true = dict(gain1=-0.02, gain2=0.02, gain3=0.0)
    scan, p = responding(true, gain='smooth')
    calibration = lm.calibrate(scan, gain=True, progress=False)
    assert {name: calibration.found.measured[name] for name in true} == pytest.approx(true, abs=0.01)
    assert np.std(calibration.corrected(scan).projections - p) < 0.5 * np.std(scan.projections - p)


@pytest.mark.thorough
def test_scattered_light_is_not_negative():
    """Missing light, mostly in the panel's middle, is not scatter: the scan stays as it is, and the lines say why."""
    scan, _ = responding({'scatter0_0': -0.02, 'scatter0_3': 0.01}, scatter='one')
    calibration = lm.calibrate(scan, scatter=True, progress=False)
    assert calibration.found.measured['scatter0_0'] < -0.01 and not calibration.found.response.parts[0].values.any()
    scatter_lines = [line for line in calibration.lines() if 'scatter' in line]
    assert len(scatter_lines) == 6 and all(', not taken: it ' in line for line in scatter_lines)
    assert 'negative in places' in scatter_lines[0] and 'negative in places' in scatter_lines[3]


@pytest.mark.thorough
def test_a_slope_of_scattered_light_alone_is_not_taken():
    """The mean of the light is unknown and taken for 0, so half of the slope would be negative."""
    scan, _ = responding({'scatter0_1': 0.02}, scatter='one')
    search = lm.calibrate(scan, scatter=True, progress=False).found
    assert (
        abs(search.measured['scatter0_1']) > 5 * search.errors['scatter0_1']
        and not search.response.parts[0].values.any()
    )


@pytest.mark.slow
def test_air_and_scatter():
    """Air is found to 0.01, and scatter to a hundredth of the open beam."""
    scan, _ = responding({'air0': 0.05, 'air1': 0.03}, air='smooth')
    search = lm.calibrate(scan, air=True, progress=False).found.measured
    assert (search['air0'], search['air1']) == pytest.approx((0.05, 0.03), abs=0.01)
    scan, _ = responding({'scatter0_0': 0.03}, scatter='one')
    search = lm.calibrate(scan, scatter=True, progress=False).found
    assert search.measured['scatter0_0'] == pytest.approx(0.03, abs=0.01)
    assert 'scatter0_0' not in search.refused and search.response.parts[0].values[0, 0] > 0.02


@pytest.mark.slow
def test_parallel_and_posed():
    geometry, data = scanner(24, mode='parallel')
    pixel = geometry.dDetector[1]
    true = Panel(u=1.3 * pixel, yaw=np.radians(-0.7))
    calibration = lm.calibrate(scanned(geometry, data, true), progress=False)
    assert in_pixels(calibration, 'u') == pytest.approx(1.3, abs=0.05)
    assert np.degrees(calibration.found.measured['yaw']) == pytest.approx(-0.7, abs=0.05)
    posed = Panel(u=-1.1 * pixel).moved(true.moved(geometry))
    calibration = lm.calibrate(lm.Scan(posed, scanned(geometry, data, true).projections), progress=False)
    assert in_pixels(calibration, 'u') == pytest.approx(1.1, abs=0.05)


def test_times_of_views():
    geometry, _ = scanner(10)
    np.testing.assert_allclose(scan_times(geometry, geometry.angles), np.linspace(-1, 1, 10), atol=1e-12)
    between = circular(10, start=18)  # the last one after the last of the scan
    np.testing.assert_allclose(scan_times(geometry, between), np.linspace(-1, 1, 10) + 1 / 9, atol=1e-12)
    np.testing.assert_allclose(scan_times(geometry, between + 2 * np.pi), np.linspace(-1, 1, 10) + 1 / 9, atol=1e-9)
    reverse = replace(geometry, angles=-geometry.angles + 1)
    np.testing.assert_allclose(scan_times(reverse, 1 - between), np.linspace(-1, 1, 10) + 1 / 9, atol=1e-9)
    shuffled = replace(geometry, angles=geometry.angles[[0, 2, 1, 3, 4, 5, 6, 7, 8, 9]])
    np.testing.assert_allclose(scan_times(shuffled, between), np.linspace(-1, 1, 10))


@pytest.mark.parametrize('total', [720.0, 1440.0])
def test_times_of_several_turns(total):
    """Times count the turns even if the angles do not, like angles of poses."""
    geometry, _ = scanner(10)
    counted = replace(geometry, angles=circular(48, total))
    for scan in (counted, replace(counted, angles=np.mod(counted.angles, 2 * np.pi))):
        expected = np.linspace(-1, 1, 48)
        np.testing.assert_allclose(scan_times(scan, scan.angles), expected, atol=1e-9)
        np.testing.assert_allclose(scan_times(scan, scan.angles[1::3]), expected[1::3], atol=1e-6)


def test_pixels_that_are_not_valid_leave_the_others():
    """Dead pixels lie in nearly every block of a binned scan, and the block is as good without them."""
    geometry, data = scanner(8)
    scan = scanned(geometry, data, Panel())
    dead = np.random.default_rng(0).random(geometry.nDetector) < 0.1
    valid = np.broadcast_to(~dead, scan.projections.shape)
    whole, holed = coarse(scan, 30), coarse(replace(scan, valid=valid), 30)
    assert holed.valid is None or holed.valid.mean() > 0.9
    assert np.abs(holed.projections - whole.projections).max() < 0.1 * whole.projections.max()


def test_bad_input():
    geometry, data = scanner(7, rows=8)
    scan = scanned(geometry, data, Panel())
    with pytest.raises(lm.InputError, match='at least 8, not 7'):
        lm.calibrate(scan, progress=False)
    with pytest.raises(lm.InputError, match='drift must be a whole number'):
        lm.calibrate(scan, drift=0.5)
    with pytest.raises(lm.InputError, match='0 to 8, not 9'):
        lm.calibrate(scan, drift=9)
    with pytest.raises(lm.InputError, match='0 to 3, not 4'):
        lm.calibrate(scan, curve=4)
    with pytest.raises(lm.InputError, match='air'):
        lm.calibrate(scan, air='smooth')
    with pytest.raises(lm.InputError, match='zero everywhere'):
        lm.calibrate(lm.Scan(geometry, np.zeros_like(scan.projections)))


@pytest.mark.thorough
def test_a_drift_that_no_view_shows_is_not_found():
    """A rod along the axis looks the same however high the panel is."""
    geometry = lm.Geometry.parallel(
        nDetector=(16, 32), dDetector=1.0, nVoxel=(24, 24, 24), dVoxel=1.0, angles=circular(24)
    )
    x, y = np.meshgrid(*2 * [np.arange(24) - 11.5], indexing='ij')
    rod = ((np.hypot(x - 2, y + 1) < 6) * 0.02)[:, :, None] * np.ones(24)
    calibration = lm.calibrate(lm.Scan(geometry, grid.project_volume(rod, geometry)), drift=3, progress=False)
    assert not any(np.abs(calibration.found.drift.panel(geometry).v).ravel() > 0)


def test_a_response_that_was_not_found_leaves_the_effects():
    geometry, data = scanner(8)
    effects = Effects(detector=Detector(photons=1e4))
    scan = lm.Scan(geometry, grid.project_volume(data, geometry), effects=effects)
    response = Response.of(geometry, air='smooth')
    drift = Drift(geometry, u=(0.5,), v=(0.3,))
    search = SearchResult(drift, response, dict(u=0.5, v=0.3), dict(u=0.01, v=0.01), {}, 1.0, 0.5)
    calibration = Calibration(geometry, search)
    moved = calibration.corrected(scan)
    assert moved.effects is effects and moved.geometry != geometry
    np.testing.assert_array_equal(moved.projections, scan.projections)
    dv, du = geometry.dDetector
    assert (
        f'({0.3 / dv:+.3f} pixels)' in calibration.lines()[1] and f'({0.5 / du:+.3f} pixels)' in calibration.lines()[0]
    )
    response.parts[0].values[0] = 0.1
    assert calibration.corrected(scan).effects is None
