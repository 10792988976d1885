"""A sound scan raises no alarm; what is wrong is noticed, and a small error is measured."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import lingo_mi as lm
from helpers.object_scan import PIXELS, scanned
from helpers.short import short
from lingo_mi.cli.findings_text import advice, facts
from lingo_mi.inspection.air import without_air
from lingo_mi.inspection.jitter import outline_jitter
from lingo_mi.inspection.measure import measure, open_beam
from lingo_mi.inspection.sheet import draw
from lingo_mi.inspection.text_order import text_order


def advised(scan):
    return advice(scan, measure(scan))


@pytest.fixture(scope='module')
def foot():
    return scanned('foot')


SOUND = {
    f'{name}, {mode}, {views} views over {total} degrees': (name, mode, total, views)
    for name in ('foot', 'shepp_logan', 'chest')
    for mode in ('cone', 'parallel')
    for total, views in ((360, 10), (360, 25), (180, 25), (220, 60))
}
SHORT = (
    'foot, cone, 10 views over 360 degrees',
    'foot, cone, 25 views over 180 degrees',
    'foot, parallel, 60 views over 220 degrees',
    'shepp_logan, cone, 10 views over 360 degrees',
    'shepp_logan, parallel, 25 views over 180 degrees',
)


@pytest.mark.parametrize('name, mode, total, views', short(SOUND, SHORT))
def test_a_sound_scan_raises_no_alarm(name, mode, total, views):
    assert advised(scanned(name, mode, views, total)) == []


@pytest.mark.slow
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize(('total', 'views'), [(360, 10), (360, 25), (180, 25), (220, 60)])
def test_a_sound_scan_of_gaussians_raises_no_alarm(mode, total, views):
    assert advised(scanned('gaussians', mode, views, total)) == []


def only(scan, words):
    (line,) = advised(scan)
    assert words in line
    return measure(scan)


def test_axis_offset_is_measured(foot):
    """An offset of three columns is measured to a tenth of a column."""
    moved = lm.Scan(foot.geometry, np.roll(foot.projections, 3, 2))
    shift = only(moved, 'the axis is off: add').orbit.shift
    assert shift == pytest.approx(-3 * foot.geometry.dDetector[1], abs=0.1 * foot.geometry.dDetector[1])
    corrected = lm.Scan(replace(foot.geometry, offDetector=(0, shift)), moved.projections)
    assert advised(corrected) == []


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_views_in_each_others_place(mode):
    scan = scanned('foot', mode)
    p = scan.projections.copy()
    p[[3, 5]] = p[[5, 3]]
    assert sorted(only(lm.Scan(scan.geometry, p), "views 3 and 5 fit better in each other's place").suspects) == [3, 5]


def test_doubled_and_black_views(foot):
    p = foot.projections.copy()
    p[4] = p[3]
    assert only(lm.Scan(foot.geometry, p), 'view 4 is the same as the one before').suspects == [4]
    p = foot.projections.copy()
    p[7] = 0
    assert only(lm.Scan(foot.geometry, p), 'view 7 is black or empty').suspects == [7]


@pytest.mark.parametrize(
    'mode, first',
    [
        ('cone', 1),
        ('parallel', 0),
        *(pytest.param(*other, marks=pytest.mark.thorough) for other in (('cone', 0), ('parallel', 1))),
    ],
)
def test_frames_sorted_by_name(mode, first):
    """Names in the order of text are 0, 1, 10, 11, ..."""
    scan = scanned('chest', mode, views=60)
    order = np.array(sorted(range(first, first + 60), key=str)) - first
    noise = np.random.default_rng(0).normal(0, 0.002 * scan.projections.max(), scan.projections.shape)
    actual = only(lm.Scan(scan.geometry, (scan.projections + noise)[order]), 'sorted by their names as text')
    np.testing.assert_array_equal(actual.text_order, order)


def test_views_of_any_other_order_are_not_sorted_by_name():
    scan = scanned('foot', views=60)
    golden = np.argsort(np.arange(60) * 137.508 % 360)
    shuffled = np.random.default_rng(0).permutation(60)
    for order in (np.arange(60), golden):
        assert text_order(scan.subset(order)) is None
    assert text_order(lm.Scan(scan.geometry, scan.projections[shuffled])) is None


@pytest.mark.parametrize(
    'noise, columns',
    [
        (0, [30]),
        (0.002, [47, 48, 49]),
        *(pytest.param(*other, marks=pytest.mark.thorough) for other in ((0, [47, 48, 49]), (0.002, [30]))),
    ],
)
def test_dead_columns(foot, columns, noise):
    p = foot.projections + noise * np.random.default_rng(0).normal(size=foot.projections.shape) * foot.projections.max()
    assert measure(lm.Scan(foot.geometry, p)).dead_columns == []
    p[:, :, columns] = 0.3 * p.max()
    assert only(lm.Scan(foot.geometry, p), ' dead, the same in all views').dead_columns == columns
    valid = np.ones(p.shape, bool)
    valid[:, :, columns] = False
    assert measure(lm.Scan(foot.geometry, p, valid)).dead_columns == []


def test_sense_and_unit_of_angles(foot):
    angles = foot.geometry.angles
    only(lm.Scan(replace(foot.geometry, angles=-angles), foot.projections), 'change the sign of the angles')
    only(lm.Scan(replace(foot.geometry, angles=np.degrees(angles)), foot.projections), 'they look like degrees')
    only(lm.Scan(replace(foot.geometry, angles=np.radians(angles)), foot.projections), 'they look like radians')


def test_air_and_truncation(foot):
    actual = only(lm.Scan(foot.geometry, foot.projections + 3), 'instead of 0: import again with --air')
    assert actual.border.air == pytest.approx(3, abs=0.1)
    cut = lm.Scan(replace(foot.geometry, nDetector=(110, 40)), foot.projections[:, :, 28:68])
    assert measure(cut).border.cut_sides > len(cut) / 2
    assert any('left or right edge' in line and '--method lingo also needs -D' in line for line in advised(cut))


def noisy(p, level, kind):
    """Projections with noise of `level`: of the highest line integral, or of the beam's photons if the object lets 5 %
    through."""
    rng = np.random.default_rng(1)
    if kind == 'equal':
        return p + rng.normal(0, level * p.max(), p.shape)
    return -np.log(np.maximum(rng.poisson(np.exp(-3 * p / p.max()) / level**2), 0.5) * level**2)


@pytest.mark.parametrize(
    'mode, kind, level',
    [
        ('cone', 'equal', 0.05),
        ('parallel', 'photons', 0.01),
        *(pytest.param('cone', 'equal', level, marks=pytest.mark.thorough) for level in (0.01, 0.02)),
        *(pytest.param('parallel', 'photons', level, marks=pytest.mark.thorough) for level in (0.02, 0.05)),
    ],
)
def test_noisy_pixels_are_not_the_object(mode, level, kind):
    """They are not at the edge, nor where the axis is measured; an object that is there is found in as many views."""
    scan = scanned('foot', mode, 60)
    assert advised(lm.Scan(scan.geometry, noisy(scan.projections, level, kind))) == []
    for part in (np.s_[:, :, 30:66], np.s_[:, 50:, :]):
        p = scan.projections[part]
        geometry = replace(scan.geometry, nDetector=p.shape[1:])
        actual, quiet = (measure(lm.Scan(geometry, q)).border for q in (noisy(p, level, kind), p))
        for name in ('cut_sides', 'cut_ends'):
            expected = getattr(quiet, name)
            assert abs(getattr(actual, name) - expected) <= 0.1 * len(scan), name
        assert max(quiet.cut_sides, quiet.cut_ends) > 20


def test_an_object_at_a_corner_of_the_edge(foot):
    """Five rows and two columns of a single view are an object, and two pixels of another view are not."""
    p = foot.projections.copy()
    p[3, 40:45, :2] = p.max()
    p[5, 40, :2] = p.max()
    assert measure(lm.Scan(foot.geometry, p)).border.cut_sides == 1


def test_pixels_that_are_not_valid_disagree_with_nothing(foot):
    valid = np.ones(foot.projections.shape, bool)
    valid[:, :, 30] = False
    actual, whole = measure(replace(foot, valid=valid)).orbit, measure(foot).orbit
    assert actual.disagreement < whole.disagreement + 0.005  # 0.056 where they count as air
    valid[:, :, 31] = False
    assert measure(replace(foot, valid=valid)).orbit.obstacle == 'gaps'


def test_scans_of_nothing_and_of_few_pixels(foot):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        dark = replace(foot, projections=0 * foot.projections)
        assert not any('nan' in line for line in facts(dark, measure(dark)))
    row = foot.subset(slice(10))
    assert measure(lm.Scan(row.geometry.binned(1), row.projections)).clipped is None


def test_the_wrong_sign_is_said_and_drawn(foot, tmp_path):
    scan = replace(foot, projections=-foot.projections)
    actual = measure(scan)
    assert any('give -ln(I / I0)' in line for line in advice(scan, actual))
    draw(tmp_path / 'sheet.png', scan, actual)
    assert (tmp_path / 'sheet.png').stat().st_size > 10_000
    assert not measure(foot).negative


@pytest.mark.parametrize('start', [90.0, 300.0])
def test_the_arc_of_views_that_are_given_as_poses(start):
    angles = np.radians(start + np.linspace(0, 180, 20, endpoint=False))
    sizes = dict(DSO=500, DSD=750, nDetector=(16, 24), dDetector=4.0, nVoxel=16, dVoxel=2.0)
    circle = lm.Geometry.cone(angles=angles, **sizes)
    posed = lm.Geometry.from_poses(circle.rays(), circle.nDetector, nVoxel=16, dVoxel=2.0)
    p = np.ones((20, 16, 24), np.float32)
    for geometry in (circle, posed):
        assert measure(lm.Scan(geometry, p)).orbit.turn == pytest.approx(np.pi)


def test_air_of_all_views(foot):
    """The advice names what takes it out: `calibrate`, which begins with `without_air`."""
    scan = lm.Scan(foot.geometry, foot.projections + np.float32(0.1 * foot.projections.max()))
    assert any('lingo-mi calibrate SCAN --out' in line for line in advised(scan))
    np.testing.assert_allclose(without_air(scan).projections, foot.projections, atol=1e-4 * foot.projections.max())


def test_air_of_single_views(foot):
    p = foot.projections + np.linspace(-1, 1, len(foot))[:, None, None] * 0.05 * foot.projections.max()
    assert any('-D fit_air=view' in line for line in advised(lm.Scan(foot.geometry, p)))


def test_a_small_drift_of_air_names_calibrate(foot):
    """Air drifts by 1 % of the highest line integral, up and down, and nothing else is found wrong."""
    p = foot.projections + np.linspace(-0.01, 0.01, len(foot))[:, None, None] * foot.projections.max()
    actual = only(lm.Scan(foot.geometry, p.astype(np.float32)), 'take it out with lingo-mi calibrate')
    assert actual.orbit.disagreement == pytest.approx(measure(foot).orbit.disagreement, abs=0.001)


@pytest.mark.parametrize('level', [0.02, pytest.param(-0.02, marks=pytest.mark.thorough)])
def test_a_drift_of_air_does_not_change_the_sense(level):
    scan = scanned('foot', views=60)
    p = scan.projections / scan.projections.max() + np.linspace(-level, level, 60)[:, None, None]
    for sense in (1, -1):
        actual = measure(lm.Scan(replace(scan.geometry, angles=sense * scan.geometry.angles), p))
        assert (actual.orbit.reversed is not None) == (sense < 0)


@pytest.mark.parametrize('counts', [1.0, 4e4])
def test_intensities(foot, counts):
    """Fractions and counts are recognised, with 2 % of noise and a beam that is a tenth darker at the edges. Nothing else is
    advised."""
    light = np.random.default_rng(0).normal(1, 0.02, foot.projections.shape)
    light = light * np.exp(-foot.projections / foot.projections.max() * 2)
    light = light * (1 - 0.1 * np.linspace(-1, 1, PIXELS) ** 2) * counts
    for p in (light, -np.log(light / light.max())):
        actual = measure(lm.Scan(foot.geometry, p))
        if p is light:
            assert actual.intensities == pytest.approx(counts, rel=0.2)  # the beam is a tenth darker at the edges
        else:
            assert actual.intensities is None
    only(lm.Scan(foot.geometry, light), 'write input: intensity and I0: ')


def test_what_is_no_intensity(foot):
    """Blank views, air with its noise and line integrals of either sign are not taken for intensities."""
    p, rng = foot.projections / foot.projections.max() * 3, np.random.default_rng(0)
    noise = rng.normal(0, 0.02, p.shape)
    blank = p.copy()
    blank[::2] = 0
    for values in (blank, noise, np.abs(noise), 4e4 + noise, np.full(p.shape, 1.0), p + noise, noise - p, 0.5 - p):
        assert open_beam(lm.Scan(foot.geometry, values.astype(np.float32))) is None


def test_fit_and_reconstruct_warn_of_intensities(foot):
    light = lm.Scan(foot.geometry, 4e4 * np.exp(-foot.projections / foot.projections.max() * 2))
    few = light.on(lm.Grid(16, 16.0)).subset(slice(0, None, 5))
    with pytest.warns(UserWarning, match='I0: 4e') as warned:
        lm.reconstruct(few, lm.FDK(), progress=False)
    assert len(warned) == 1
    with pytest.warns(UserWarning, match='I0: 4e'):
        lm.fit(few, iterations=1, n_points=20, progress=False)


@pytest.mark.thorough
def test_regions_of_interest_are_no_intensities():
    for name in ('foot', 'chest', 'shepp_logan', 'gaussians'):
        scan = scanned(name)
        for half in (8, 16, 24):
            middle = slice(PIXELS // 2 - half, PIXELS // 2 + half)
            cut = lm.Scan(replace(scan.geometry, nDetector=(110, 2 * half)), scan.projections[:, :, middle])
            assert measure(cut).intensities is None


def test_noise(foot):
    """The number of photons is measured to 20 %."""
    rng = np.random.default_rng(0)
    p = foot.projections / foot.projections.max() * 2
    noisy = -np.log(rng.poisson(2e4 * np.exp(-p)) / 2e4)
    assert measure(lm.Scan(foot.geometry, noisy)).photons == pytest.approx(2e4, rel=0.2)


@pytest.fixture(scope='module')
def dense():
    return scanned('foot', views=90)


@pytest.mark.parametrize(('deviation', 'unsteady'), [(0.4, False), (1.5, True)])
def test_jitter_is_measured(dense, deviation, unsteady):
    """It is measured to 30 % from 90 views."""
    by = np.random.default_rng(0).normal(0, deviation, (len(dense), 2))
    moved = np.stack([ndimage.shift(v, s, order=1) for v, s in zip(dense.projections, by)])
    scan = lm.Scan(dense.geometry, moved)
    assert measure(scan).jitter[0] == pytest.approx(deviation, rel=0.3)
    assert any('-D rate_pose' in line for line in advised(scan)) == unsteady


def test_a_steady_outline(dense):
    assert all(x < 0.15 for x in outline_jitter(dense.projections, dense.geometry.angles))
    sparse = np.delete(dense.projections, np.arange(0, 90, 2), 0)
    assert np.isnan(outline_jitter(sparse, dense.geometry.angles[1::2])).all()  # 8 degrees apart


def test_parallel_views_have_one_mass():
    scan = scanned('foot', 'parallel')
    gain = 1 + 0.1 * np.sin(np.arange(len(scan)))
    only(lm.Scan(scan.geometry, scan.projections * gain[:, None, None]), 'the mass of the views differs by 7')
    assert advised(scan) == []


def test_a_short_arc_does_not_tell_the_axis():
    scan = scanned('foot', views=40)
    for first in (0, 10, 25):
        part = scan.subset(np.arange(first, first + 10))
        assert advised(part) == [] and measure(part).orbit.short


def test_views_of_one_angle(foot):
    same = replace(foot.geometry, angles=np.zeros(len(foot)))
    assert 'all views have the same angle' in advised(replace(foot, geometry=same))[0]


def test_lengths_in_other_units(foot):
    wide = replace(foot.geometry, dDetector=(1000 * foot.geometry.dDetector[0], 1000 * foot.geometry.dDetector[1]))
    assert any(
        'give DSO, DSD and the size of the pixels in mm' in line for line in advised(replace(foot, geometry=wide))
    )


@pytest.mark.parametrize('level', [0.05, 0.3])
def test_an_air_level_that_is_not_0(foot, level):
    """Flats of more exposure than the views do not look like an object that fills the panel."""
    lifted = replace(foot, projections=foot.projections + np.float32(level * foot.projections.max()))
    assert measure(lifted).border.air == pytest.approx(level * foot.projections.max(), rel=0.02)
    assert [line[:6] for line in advised(lifted)] == ['air is']
