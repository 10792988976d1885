"""Hard cases: line integrals and voxels where float32 is pressed, any cloud in any geometry, and fits on bad data."""

import itertools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from helpers.script import FIT
from helpers.script import run as run_script
from lingo_mi.common.errors import AccuracyWarning, InputError
from lingo_mi.common.runtime import use_threads
from lingo_mi.fitting.activations import inverse_scale, inverse_softplus, softplus
from lingo_mi.fitting.densify import clone, densify, halve, split
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.losses import combined
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.state import activate, start
from lingo_mi.geometry import CircularGeometry, Geometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.lingo.loss_scale import loss_scale, otsu_on_device
from lingo_mi.lingo.masks import Masks, masks
from lingo_mi.lingo.otsu import otsu as otsu_of_paper
from lingo_mi.lingo.scaling import occupancy, scale_factor, scaled_grid
from lingo_mi.metrics.quality import ssim_map
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.view import View, vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, Pose, random_cloud, relative
from studies.hard_cases import measuring
from studies.hard_cases.cases import all_cases
from studies.hard_cases.clouds import scanner
from studies.hard_cases.kinds import ScanCase
from studies.hard_cases.measuring import Result, errors, host, image_and_gradients, measure, miss, on_device, weights_of
from studies.hard_cases.scans import adversarial, fit_to
from studies.hard_cases.table import markdown, store, stored

CASES = all_cases()


@pytest.fixture(scope='module', autouse=True)
def two_threads(variant):
    """Sums of many Gaussians are split among the threads, so their errors hold for two threads or more."""
    before = dr.thread_count()
    use_threads(max(2, before))
    yield
    use_threads(before)


LONG = (
    '1 million coincident Gaussians',
    '1 million Gaussians',
    '1000 views',
    'views empty, saturated, noisy, repeated; Gaussians coincident',
    *(
        f'{kind} 1:1e4, {place}'
        for kind, place in itertools.product(
            ('needles', 'pancakes'), ('cone, close up', 'parallel, close up', 'cone, whole', 'parallel, whole')
        )
        if (kind, place) not in (('needles', 'cone, close up'), ('pancakes', 'parallel, whole'))
    ),
)


# Between cases that the short form runs, or the other beam of one that it runs.
LIKE = {
    *('pancakes 1:1e4, parallel, whole', 'pancakes 1:1e4 seen edge on, cone', 'needles 1:1e4 seen end on, parallel'),
    *('1 x 4096 pixels, cone', '4096 x 1 pixels, parallel', 'projections with negative values'),
    *(
        'scale 1e0 pixels, parallel',
        'scale 1e-1 pixels, cone',
        'scale 1e-1 pixels, parallel',
        'scale 1e-2 pixels, parallel',
    ),
    *('scale 1e-4 pixels, cone', 'voxels: scale 1e-2 voxels', 'voxels: scale 1e-4 voxels', 'voxels: pancakes 1:1e4'),
    *('density 1e-12, parallel', 'density 0, parallel', 'density 1e+06, parallel'),
    *('quaternions of length 1e+12, parallel', 'quaternions of length 1e-12, cone'),
    *('view at 0.5759587 rad, parallel', 'view at 0.5759597 rad, cone', 'view at 0.5759597 rad, parallel'),
    *('world offset of 1e+04 scenes, parallel', 'world offset of 1e+06 scenes, cone'),
}


def marked(case):
    return pytest.param(case, marks=pytest.mark.thorough if case.name in {*LONG, *LIKE} else (), id=case.name)


def test_cases_are_named():
    assert {*LONG, *LIKE} <= {case.name for case in CASES}


@pytest.mark.parametrize('case', [marked(case) for case in CASES])
def test_case(case, variant):
    assert not miss(case, measure(case), variant)


def test_what_counts_as_a_miss():
    """Each way to miss is told from the others; so is what is allowed."""

    def miss(case, result, variant='llvm_ad_mono'):
        return measuring.miss(case, result, variant)

    case = next(case for case in CASES if case.name == 'density 1e-12, cone')
    good = Result(image=1e-7, gradients=dict(centre=1e-6))
    assert not miss(case, good)
    assert 'image 1.0e-05' in miss(case, replace(good, image=1e-5)) and 'image' in miss(
        case, replace(good, image=np.nan)
    )
    assert 'derivative 1.0e-04' in miss(case, replace(good, gradients=dict(centre=1e-7, scale=1e-4)))
    assert 'derivative' in miss(case, replace(good, gradients=dict(centre=np.nan)))
    assert 'warned' in miss(case, replace(good, warned='coarse')) and 'refused' in miss(case, Result(refused='no'))
    refused = ScanCase('no', lambda: None, refused='not finite')
    assert not miss(refused, Result(refused='p: not finite'))
    assert 'not refused' in miss(refused, Result()) and 'else' in miss(refused, Result(refused='else'))
    assert miss(ScanCase('ends', lambda: None), Result(failed='the fit ends')) == 'the fit ends'
    assert miss(ScanCase('warns', lambda: None, warned=True), Result()) == 'not warned of'
    approximate = replace(good, image=1.5e-6, gradients=dict(centre=1.5e-5))  # as a GPU's instructions are
    assert miss(case, approximate) and not miss(case, approximate, 'cuda_ad_mono')
    assert 'at most 1.6e-06' in miss(case, replace(good, image=1.7e-6), 'cuda_ad_mono')


def test_a_fit_that_does_not_end_finite_is_a_miss():
    def act():
        raise FloatingPointError('the fit ends with losses that are not finite')

    case = ScanCase('ends', act)
    assert 'losses' in miss(case, measure(case), 'llvm_ad_mono')


def test_table():
    named = {case.name: case for case in CASES}
    assert len(named) == len(CASES)
    chosen = [named[name] for name in ('density 0, cone', 'zero quaternion', 'needle 1:5e6')]
    text = markdown([(case, measure(case)) for case in chosen])
    lines = [line for line in text.splitlines() if line.startswith('|')]
    assert len(lines) == 5 and len({line.count('|') for line in lines}) == 1
    assert 'refused: Gaussian 0' in lines[3] and 'warned: the scales' in lines[4]


def test_table_of_two_variants(tmp_path):
    """Worst derivatives share a column; the remark tells of a miss, of another note, and of an absent case."""
    case = next(case for case in CASES if case.name == 'density 1e-12, cone')
    fit = ScanCase('a fit', lambda: None, note='30 steps')
    absent = ScanCase('absent', lambda: None)
    good = Result(image=1e-7, gradients=dict(centre=1e-7, scale=2e-7, rotation=3e-7, density=4e-7))
    there = replace(good, image=5e-7, gradients=dict(good.gradients, scale=6e-3))
    store(tmp_path / 'there.json', 'cuda_ad_mono', [(case, there), (replace(fit, note='3 steps'), Result())])
    beside = stored(tmp_path / 'there.json')
    assert beside.title == 'CUDA' and beside.results[case.name] == there
    assert beside.misses([case, fit, absent]) == {case.name: 'error of a derivative 6.0e-03, at most 1.6e-05'}
    text = markdown([(case, good), (fit, Result()), (absent, Result())], beside)
    head, _, *rows = ([cell.strip() for cell in line.split('|')] for line in text.splitlines() if line[:1] == '|')
    by_title = dict(zip(head, rows[0]))
    assert by_title['image, CUDA'] == '5e-07' and by_title['derivatives, CUDA'] == '6e-03'
    assert by_title['image'] == '1e-07' and by_title['scale'] == '2e-07'
    assert by_title['remark'] == 'CUDA: error of a derivative 6.0e-03, at most 1.6e-05'
    assert [dict(zip(head, row))['remark'] for row in rows[1:]] == ['30 steps; CUDA: 3 steps', 'CUDA: not measured']


@pytest.mark.parametrize(
    'text', ['', '[]', '{}', '[{"name": "x"}]', '[{"name": "x", "variant": "v", "note": "", "y": 1}]']
)
def test_what_is_no_file_of_results(tmp_path, text):
    (tmp_path / 'other.json').write_text(text)
    with pytest.raises(InputError, match='not a file of hard cases'):
        stored(tmp_path / 'other.json')


def test_committed_results_miss_nothing():
    """All cases are there, and none misses its tolerance."""
    results = stored(FIT.parents[1] / 'docs' / 'tables' / 'hard_cases.cuda.json')
    assert results.variant == 'cuda_ad_mono' and {case.name for case in CASES} <= set(results.results)
    assert not results.misses(CASES)


def test_command(tmp_path, monkeypatch):
    """It writes the page and how it was made. The exit code and a line tell of each case that misses its tolerance."""
    good = next(case for case in CASES if case.name == 'density 0, cone')
    cases = [good, replace(good, name='too good', warned=True)]
    monkeypatch.setattr('studies.hard_cases.cases.all_cases', lambda steps: cases[:1])
    page = tmp_path / 'page.md'
    code, out, err = run_script('studies.hard_cases', '--markdown', page)
    assert code == 0 and not err and page.read_text() == out and '| density 0, cone |' in out
    assert 'studies.hard_cases' in (tmp_path / 'page.provenance.json').read_text()
    monkeypatch.setattr('studies.hard_cases.cases.all_cases', lambda steps: cases)
    code, out, err = run_script('studies.hard_cases')
    assert code == 1 and '| too good |' in out and err == 'missed its tolerance: too good: not warned of\n'
    there = tmp_path / 'there.json'
    run_script('studies.hard_cases', '--json', there)
    monkeypatch.setattr('studies.hard_cases.cases.all_cases', lambda steps: cases[:steps])
    title = mi.variant().split('_')[0].upper()
    code, out, err = run_script('studies.hard_cases', '--beside', there, '--steps', 1)
    assert code == 0 and not err and f'image, {title}' in out and 'too good' not in out
    code, out, err = run_script('studies.hard_cases', '--beside', there)
    assert code == 1 and f'missed its tolerance: too good, {title}: not warned of' in err
    code, out, _ = run_script('studies.hard_cases', '--without', 'good', 'nothing')
    assert code == 0 and '| density 0, cone |' in out and 'too good' not in out
    assert run_script('studies.hard_cases', '--steps', 0)[0] == 2


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize(
    'name, value',
    [
        ('centre', [0, np.nan, 0]),
        ('scale', [0.1, 0, 0.1]),
        ('scale', [0.1, np.nan, 0.1]),
        ('rotation', [0, 0, 0, 0]),
        ('rotation', [0, 0, np.nan, 1]),
        ('density', np.nan),
        ('density', np.inf),
    ],
)
def test_a_gaussian_that_is_no_number_is_never_skipped(mode, name, value):
    """A direct call of the projector gives an image without finite values; scenes are refused by name (above)."""
    frames, shape = scanner(mode)
    cloud = random_cloud(np.random.default_rng(0), 5)
    values = getattr(cloud, name).copy()
    values[2] = value
    cloud = cloud.changed(**{name: values})
    image, _ = image_and_gradients(cloud, frames, shape, weights_of(shape))
    assert not np.isfinite(image).any()
    grid = Lattice(vector64([-1, -1, -1]), vector64([0.2] * 3), (10, 10, 10))
    assert not np.isfinite(voxelize(*on_device(cloud), grid, 3.0).numpy()).any()


@pytest.mark.parametrize('model', [dict(footprint='affine'), dict(area=True)], ids=['affine', 'area'])
def test_models_that_do_not_reach_a_gaussian_at_the_source(model):
    frames, shape = scanner()
    beside = Cloud(frames.source + 0.01, [[0.02] * 3], [[0, 0, 0, 1]], [1.0])
    with pytest.warns(AccuracyWarning, match='1 Gaussians reach to the source'):
        line_integrals(*on_device(beside), View.of(frames, 0, *shape), RenderOptions(4.0, **model))


@pytest.mark.parametrize('side, sigma', [(33, 1.0), (513, 0.1)])
def test_a_pile_of_gaussians_is_summed_as_accurately_as_one(side, sigma):
    """This holds however small they are, and wherever they are in the order of the cloud."""
    count = 20_000
    frames, shape = scanner(shape=(side, side), size=(3.2, 3.2))
    one = Cloud([[0, 0, 0]], [[sigma * 3.2 / side / 1.5] * 3], [[0.1, 0.2, 0.3, 0.9]], [0.7])
    away = one.changed(centre=np.array([[0, 0, 0.3]]))
    view = View.of(frames, 0, *shape)

    def image(copies):
        parts = [[x[np.zeros(copies, int)] for x in (c.centre, c.scale, c.rotation, c.density)] for c in (one, away)]
        cloud = Cloud(*(np.stack(pair, 1).reshape(-1, *pair[0].shape[1:]) for pair in zip(*parts)))
        return line_integrals(*on_device(cloud), view, RenderOptions(4.0)).numpy().astype(float)

    assert relative(image(count), count * image(1)) < 3e-6


def test_a_pile_of_gaussians_in_voxels():
    count, grid = 20_000, Lattice(vector64([-1, -1, -1]), vector64([0.1] * 3), (20, 20, 20))
    one = Cloud([[0.03, 0.02, -0.01]], [[0.03, 0.05, 0.04]], [[0.1, 0.2, 0.3, 0.9]], [0.7])
    actual, expected = (voxelize(*on_device(one[np.zeros(n, int)]), grid, 4.0, deep=True).numpy() for n in (count, 1))
    assert relative(actual, count * expected.astype(float)) < 3e-6


# ------------------------------------------------------------------------------------------------------------
#  Any cloud in any geometry
# ------------------------------------------------------------------------------------------------------------


def number(low, high):
    return st.floats(low, high)


def vectors(low, high, size):
    return st.lists(number(low, high), min_size=size, max_size=size)


@st.composite
def clouds(draw):
    """One to four Gaussians in and around [-1, 1]^3, scales from 1e-4 to 2, aspects up to 2e4, densities of either sign; or as
    many copies of the first."""
    n = draw(st.integers(1, 4))
    rows = [
        (
            draw(vectors(-1.5, 1.5, 3)),
            draw(vectors(-4, 0.3, 3)),
            draw(vectors(-1, 1, 4)),
            draw(number(-3, 3)),
            draw(number(-6, 3)),
        )
        for _ in range(n)
    ]
    centre, scale, rotation, length, density = (np.array(column, float) for column in zip(*rows))
    norm = np.linalg.norm(rotation, axis=1, keepdims=True)
    assume(norm.min() > 1e-2)
    sign = draw(st.sampled_from([1, -1]))  # one for all: where they cancel, there is nothing to compare with
    cloud = Cloud(centre, 10**scale, rotation / norm * 10 ** length[:, None], sign * 10**density)
    return cloud[np.zeros(n, int)] if draw(st.booleans()) else cloud


@st.composite
def views(draw):
    """A view of a cone or a parallel beam with offsets, tilted and turned, pixels up to 100 times as long as wide."""
    shape = draw(st.sampled_from([(7, 10), (12, 5), (1, 16), (9, 1)]))
    height, width = draw(number(0.05, 3)), draw(number(0.05, 3))
    mode, DSO = draw(st.sampled_from(['cone', 'parallel'])), draw(number(2, 50))
    geometry = Geometry.per_view(
        DSO=DSO,
        DSD=DSO * draw(number(1, 2)),
        nDetector=shape,
        dDetector=(height / shape[0], width / shape[1]),
        nVoxel=8,
        dVoxel=0.25,
        angles=np.radians([draw(number(0, 360))]),
        mode=mode,
        offDetector=draw(vectors(-0.7, 0.7, 2)),
        tilt=draw(number(-0.5, 0.5)),
        rotDetector=draw(vectors(-0.3, 0.3, 3)),
    )
    return geometry.rays(), shape, draw(number(8, 12))


def compare(cloud, view):
    frames, shape, extent = view
    weights, pose = weights_of(shape), Pose.of(frames, 0, *shape)
    image, gradients = image_and_gradients(cloud, frames, shape, weights, extent)
    result = errors(cloud, image, gradients, oracle.line_integrals(cloud, pose), oracle.gradients(cloud, pose, weights))
    # Of a far tail float32 knows the exponent, 25 or more, to its last digit only; its derivatives magnify that.
    assert result.image <= 1e-5 and max(result.gradients.values()) <= 2e-4, result


COMMON = dict(deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None)
settings.register_profile('short', max_examples=50, **COMMON)
settings.register_profile('ci', max_examples=200, **COMMON)
settings.register_profile('nightly', max_examples=10_000, **COMMON)


@settings(settings.get_profile('short'))
@given(clouds(), views())
def test_any_cloud_in_any_view(cloud, view):
    compare(cloud, view)


@pytest.mark.thorough
@settings(settings.get_profile('ci'))
@given(clouds(), views())
def test_more_clouds_in_more_views(cloud, view):
    compare(cloud, view)


@pytest.mark.slow
@settings(settings.get_profile('nightly'))
@given(clouds(), views())
def test_any_cloud_in_any_view_at_length(cloud, view):
    compare(cloud, view)


# ------------------------------------------------------------------------------------------------------------
#  Fits
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_long_fit_of_bad_data_ends_finite():
    fit_to(adversarial(), 10_000)


CONTROL, FORWARD = R2().changed(densify_threshold=1e-3, split_size=0.15).densify, R2().forward


def coincident(n=8):
    state = start(np.zeros((n, 3)), np.where(np.arange(n) % 2, 0.1, 0.3), np.full(n, 0.5), FORWARD)
    state.gradient[:], state.visits[:] = 1, 1
    return state


def mass(state):
    _, scale, _, density = activate(state, FORWARD)
    return (density * scale.prod(1)).sum()


def test_coincident_gaussians_densify():
    state = coincident()
    after = densify(state, CONTROL, FORWARD, np.ones(3), np.random.default_rng(0))
    assert len(after) == 16 and all(np.isfinite(v).all() for v in after.values.values())
    everyone = np.ones(8, bool)
    assert abs(mass(clone(state, everyone, FORWARD)) / mass(state) - 1) < 1e-5
    assert abs(mass(halve(state, everyone, FORWARD)) / mass(state) - 1) < 1e-5
    halves = split(state, everyone, FORWARD, np.random.default_rng(0))
    assert len(np.unique(halves.values['centre'], axis=0)) == 16  # drawn from their parents, so no longer at one place


@pytest.mark.parametrize('value', [0.0, 0.004, 0.02, 0.9])
def test_dynamic_scale_at_its_corner(value):
    """T_g + 1 / (4 T_g) with T_g = max(0.01, Otsu) is a constant to the derivative, on either side of the corner."""
    image, truth = mi.Float([value, value * 0.5, value, value * 0.5]), mi.Float([0.1, 0.2, 0.3, 0.4])
    dr.enable_grad(image)
    factor = loss_scale(image)
    threshold = max(0.01, otsu_on_device(image)[0])
    assert abs(factor[0] - (threshold + 0.25 / threshold)) < 1e-5 * factor[0] and not dr.grad_enabled(factor)
    assert factor[0] <= 25.01 * (1 + 1e-6)
    dr.backward(dr.sum(dr.abs(image - truth)) * factor)
    np.testing.assert_allclose(dr.grad(image).numpy(), factor[0] * np.sign(image.numpy() - truth.numpy()), rtol=1e-6)


@pytest.mark.parametrize('a, b', [(0, 0), (0.5, 0.5), (0, 0.5), (0.3, 0.5), (1e4, 1e4), (1e4, 0), (0, 1e-20)])
def test_ssim_of_constant_images(a, b):
    shape = 20, 25
    image, truth = (dr.full(mi.Float, x, shape[0] * shape[1]) for x in (a, b))
    dr.make_opaque(image, truth)
    dr.enable_grad(image)
    value = 1 - combined(image, truth, *shape, lambda_ssim=1.0, lambda_l1=0.0)
    assert abs(value[0] - ssim_map(np.full(shape, float(a)), np.full(shape, float(b))).mean()) < 1e-5
    dr.backward(value + combined(image, truth, *shape))
    assert np.isfinite(dr.grad(image).numpy()).all()
    if a == b:
        assert abs(value[0] - 1) < 1e-6 and np.abs(dr.grad(image).numpy()).max() < 1e-6


def raw_state(scale=0.0, density=0.0, rotation=(0, 0, 0, 1)):
    state = start(np.zeros((2, 3)), np.full(2, 0.1), np.ones(2), FORWARD)
    state.values['scale'][:], state.values['density'][:], state.values['rotation'][:] = scale, density, rotation
    return state


@pytest.mark.parametrize('raw', [-1e30, -1e4, -90, -20, 0, 20, 90, 1e4, 1e30])
def test_activations_at_both_ends(raw):
    """Values are finite and within their bounds, and derivatives finite, the same on the host and on the device."""
    state = raw_state(scale=raw, density=raw)
    with np.errstate(over='ignore'):
        _, scale, _, density = activate(state, FORWARD)
    device = DeviceState(state)
    dr.enable_grad(list(device.values.values()))
    _, scale_there, _, density_there = FORWARD.gaussians(device.values)
    assert (
        np.all((scale >= FORWARD.bounds.scale_min) & (scale <= FORWARD.bounds.scale_max)) and np.isfinite(density).all()
    )
    np.testing.assert_allclose(np.array(scale_there).T, scale, rtol=2e-6)
    np.testing.assert_allclose(density_there.numpy(), density, rtol=2e-6, atol=1e-7)
    dr.backward(dr.sum(scale_there.x) + dr.sum(density_there))
    slopes = [host(dr.grad(device.values[k])) for k in ('scale', 'density')]
    assert all(np.isfinite(s).all() and (s >= 0).all() for s in slopes)


def test_inverses_at_both_ends():
    y = np.array([0, 1e-300, 1e-30, 1e-7, 1, 700, 1e8])
    np.testing.assert_allclose(softplus(inverse_softplus(y)), np.maximum(y, 1e-30), rtol=1e-12)
    low, high = FORWARD.bounds.scale_min, FORWARD.bounds.scale_max
    inner = np.array([low * (1 + 1e-6), low * 1.5, 0.5, high * (1 - 1e-6)])
    raw = inverse_scale(inner, low, high)
    np.testing.assert_allclose(low + (high - low) / (1 + np.exp(-raw)), inner, rtol=1e-9)


@pytest.mark.parametrize('length', [1e-14, 1e-7, 1e7, 1e14])
def test_length_of_a_quaternion_does_not_matter(length):
    """Only its own derivative is the other way round, so that a step of Adam is harmless near zero."""
    frames, shape = scanner()
    cloud, weights = random_cloud(np.random.default_rng(1), 4), weights_of(shape)
    cloud = cloud.changed(rotation=cloud.rotation / np.linalg.norm(cloud.rotation, axis=1, keepdims=True))
    image, gradients = image_and_gradients(cloud, frames, shape, weights)
    scaled, scaled_gradients = image_and_gradients(
        cloud.changed(rotation=length * cloud.rotation), frames, shape, weights
    )
    np.testing.assert_allclose(scaled, image, rtol=1e-4, atol=1e-6 * image.max())
    size = np.abs(gradients['rotation']).max()
    np.testing.assert_allclose(length * scaled_gradients['rotation'], gradients['rotation'], atol=1e-5 * size)


@pytest.mark.parametrize('value', [-1.0, 0.0, 1e-30, 0.3, 1e30])
def test_otsu_of_flat_images(value):
    image = np.full((6, 7), value, np.float32)
    assert otsu_of_paper(image) == image[0, 0] == otsu_on_device(mi.Float(image.ravel()))[0]
    if value >= 0:
        masked = masks(image[None])
        assert not masked.high.any()


@pytest.mark.parametrize('full, expected', [(False, 0.0), (True, 1.0)])
def test_voxel_scaling_at_the_ends_of_occupancy(full, expected):
    geometry = CircularGeometry(
        DSO=5.0, DSD=7.0, nDetector=(40, 40), dDetector=0.2, angles=circular(4), grid=Grid(32, 0.0625)
    )
    everywhere = np.full((4, 40, 40), full)
    P = occupancy(
        geometry.normalised_rays(),
        Masks(everywhere, everywhere, np.zeros(4), np.zeros(4)),
        geometry.grid.half,
        geometry.grid.shape,
    )
    assert P == expected
    S = scale_factor(P)
    assert S == (20 if full else 1)
    assert scaled_grid(geometry.grid.shape, S) == ((8, 8, 8) if full else (32, 32, 32))
