"""The fit on tiny scans: it descends, resumes to the bit, compiles nothing late, and refuses what it must."""

import subprocess
import sys
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.fits import SHORT, Points, assert_equal_states, error_of, geometry, some_points, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.fitting import step, view_loss
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods import cloud_method
from lingo_mi.fitting.methods.by_name import CLOUDS, METHODS
from lingo_mi.fitting.start.start import StartingCloud
from lingo_mi.fitting.state import activate
from lingo_mi.fitting.state import start as start_state
from lingo_mi.fitting.total_variation import random_cube_variation
from lingo_mi.geometry.grid import Grid
from lingo_mi.scan import Scan

# ------------------------------------------------------------------------------------------------------------
#  Progress
# ------------------------------------------------------------------------------------------------------------


def test_loss_falls(scan, whole):
    losses = [entry['loss'] for entry in whole.history]
    assert [entry['iteration'] for entry in whole.history][-1] == 30
    assert losses[-1] < 0.7 * losses[0]
    before = run(scan, SHORT.changed(iterations=1), seed=3)
    assert error_of(whole, scan) < 0.7 * error_of(before, scan)
    assert len(whole.state) > 60 and whole.state.born.any()  # densification did something
    assert all(np.isfinite(v).all() for v in whole.state.values.values())


def test_a_small_scan_bounds_the_number_of_gaussians(scan, whole):
    assert len(whole.state) > 65
    few = SHORT.changed(values_per_gaussian=scan.projections.size / 65)
    assert len(run(scan, few, seed=3).state) <= 65
    assert len(few.changed(start='masks', n_points=500).starting_cloud(scan)) == 65


def test_more_than_the_scan_or_the_memory_has(scan, monkeypatch):
    with pytest.raises(InputError, match='at most the 3 of the scan, not 4'):
        SHORT.changed(batch=4).starting_cloud(scan)
    with pytest.raises(InputError, match='at most the 3 of the scan, not 1000000'):
        run(scan, SHORT.changed(batch=10**6))
    monkeypatch.setattr(cloud_method, 'room', lambda: 2**20)
    for method in (SHORT.changed(start='masks', n_points=10**8), METHODS['3dgs'].changed(n_points=3000)):
        with pytest.raises(InputError, match='lower n_points'):
            method.starting_cloud(scan)
    SHORT.changed(start='fdk', n_points=2000).bounded(scan)
    METHODS['xgaussian'].bounded(scan)


RATES = {f'rate_{name}': ((1e-12,) * 2, (1e3,) * 2) for name in ('centre', 'density', 'scale', 'rotation')}
ENDS = RATES | dict(
    rate_pose=((1e-12, 1e-12), (1.0, 1.0)),
    tv_stride=(1, 1e6),
    tv_size=(1, 1e6),
    tv_views=(0, 1e6),
    V_S=(0, 1e6),
    occupancy_voxels=(1, 1e6),
    misses=(0, 1e6),
    decay_steps=(0, 1e9),
    batch=(1, 3),
    high_fraction=(0, 1),
    low_factor=(0, 1e6),
    extent=(1, 20),
    lambda_l1=(0, 1e6),
    lambda_ssim=(0, 1e6),
    lambda_gradient=(0, 1e6),
    lambda_tv=(0, 1e6),
    beta1=(0, 1 - 1e-6),
    beta2=(0, 1 - 1e-6),
    epsilon=(1e-30, 1),
    average=(0, 1 - 1e-6),
    densify_threshold=(0, 1e6),
    split_size=(0, 1e6),
    prune_density=(0, 1e6),
    values_per_gaussian=(0, 1e9),
    scale_min=(1e-9, 0.99),
    scale_max=(2e-3, 1e3),
    fdk_threshold=(-1e6, 1e6),
    fdk_rescale=(0, 1e6),
)
SOON = 'rate_pose', 'rate_centre', 'tv_stride', 'epsilon'


@pytest.mark.parametrize('name', [pytest.param(k, marks=[] if k in SOON else pytest.mark.slow) for k in ENDS])
def test_the_ends_of_every_range(scan, name, tmp_path):
    """With an option as far as it may go, a fit gives a result, or one line."""
    usual = SHORT.changed(
        iterations=3,
        start='fdk' if name.startswith('fdk') else 'masks',
        n_points=60,
        densify_from=0,
        densify_every=1,
        rate_pose=(1e-3, 1e-3),
        average=0.5,
        max_gaussians=200,
    )
    for value in ENDS[name]:
        method = usual.changed(**{name: value})
        try:
            fitted = run(scan, method, path=tmp_path / 'fit.npz')
        except InputError as error:
            assert '\n' not in str(error) and len(str(error)) < 300
        else:
            assert np.isfinite(fitted.volume()).all() and len(Checkpoint.load(tmp_path / 'fit.npz').state) > 0


def test_progress_and_measure_are_called(scan):
    steps, measured = [], []
    run(
        scan,
        SHORT.changed(iterations=8),
        measure=lambda fit: measured.append(len(fit)) or {'psnr2d': 1.0},
        progress=lambda done, loss, gaussians, **rest: steps.append((done, loss(), gaussians, rest)),
    )
    assert [s[0] for s in steps] == list(range(1, 9)) and all(np.isfinite(s[1]) for s in steps)
    assert measured and steps[-1][3] == {'psnr2d': 1.0}


def test_same_seed_same_fit(scan, whole, sums_in_order):
    assert_equal_states(run(scan, SHORT, seed=3).state, whole.state)
    other = run(scan, SHORT, seed=4).state
    assert len(other) != len(whole.state) or not np.array_equal(other.values['centre'], whole.state.values['centre'])


@pytest.mark.parametrize('name', CLOUDS)
def test_each_method(name, scan):
    method = METHODS[name].changed(iterations=8, n_points=200, densify_from=2, densify_every=3, tv_size=8)
    fitted = run(scan, method.changed(fdk_threshold=1e-3) if name == 'r2' else method)
    assert len(fitted.state) > 0 and np.isfinite(error_of(fitted, scan))
    assert fitted.history[-1]['iteration'] == 8
    volume = fitted.volume()
    assert volume.shape == scan.geometry.grid.shape and volume.max() > 0


@pytest.mark.parametrize('densify', [dict(densify='clone', split_size=0.08), dict(densify='halve')])
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_fan_beam_stays_in_its_plane(mode, densify):
    """With one row and one slice, nothing may leave the plane or turn out of it."""
    g = geometry(6, nDetector=(1, 48), dDetector=(8.0, 8.0), nVoxel=(32, 32, 1), mode=mode)
    scan, method = tiny_scan(g, flat=True), SHORT.changed(**densify)
    fitted = run(scan, method)
    assert fitted.state.born.any()  # clones and halves of splits, which are drawn at random
    centre, scale, rotation, _ = activate(fitted.state, fitted.method.forward)
    assert not centre[:, 2].any() and not rotation[:, :2].any()
    np.testing.assert_allclose(scale[:, 2], 0.08, rtol=1e-5)
    before = run(scan, method.changed(iterations=1))
    assert error_of(fitted, scan) < 0.9 * error_of(before, scan)


@pytest.mark.parametrize('stride', [1, 2, 3])
def test_total_variation_is_of_every_nth_voxel(scan, stride):
    """The samples are so many that they fit in one place only, between the first and the last voxels."""
    g = scan.geometry.on(Grid((13, 13, 7), (20.0, 20.0, 36.0), scan.geometry.grid.centre))
    method = SHORT.changed(tv_stride=stride, tv_size=13, extent=6.0)
    model, forward, start = method.model(g, 0.5), method.forward, some_points(g)
    state = DeviceState(start_state(start.points.astype(np.float32), start.spacing, start.density, forward))
    gaussians = forward.gaussians(state.values)
    dr.enable_grad(gaussians)
    actual = random_cube_variation(gaussians, g, method.loss, method.extent, np.random.default_rng(0))[0]
    volume = model.volume(state)[::stride, ::stride, ::stride] / model.unit
    wanted = np.concatenate([np.diff(volume, axis=i).ravel() for i in range(3)])
    np.testing.assert_allclose(actual, method.loss.lambda_tv * np.abs(wanted).mean(), rtol=1e-5)


@pytest.mark.parametrize('batch', [1, 2])
def test_the_dynamic_factor_is_on_the_whole_loss(scan, batch, monkeypatch):
    """It multiplies L1, SSIM and total variation alike (paper, section III-C), so the step's gradient is the plain one times
    the factor.

    With a batch of views, the total variation has the mean of their factors.
    """
    factors = iter([3.0, 5.0][:batch])
    monkeypatch.setattr(view_loss, 'loss_scale', lambda image: mi.Float(next(factors)))

    def gradients(views, **changes):
        results = {}
        monkeypatch.setattr(step, 'adam_step', lambda state, gradients, *_: results.update(gradients))
        stepper = SHORT.changed(tv_size=9, batch=batch, **changes).stepper(scan)
        state = DeviceState(stepper.begin(0)[0])
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            stepper.step(state, views, 0, np.random.default_rng(7))
        return {name: x.numpy() for name, x in results.items()}

    views = list(range(batch))
    scaled = gradients(views, loss_scale='dynamic')
    both = gradients(views, lambda_tv=0.0, loss_scale='none'), gradients(views, loss_scale='none')
    variation = {name: both[1][name] - both[0][name] for name in scaled}
    single = [gradients([view], lambda_tv=0.0, loss_scale='none') for view in views]
    for name in ('centre', 'density', 'scale'):  # spheres have no rotation
        results = scaled[name]
        wanted = sum(f * one[name] for f, one in zip((3, 5), single)) / batch + (3, 4)[batch - 1] * variation[name]
        assert np.abs(variation[name]).max() > 1e-3 * np.abs(results).max(), name
        np.testing.assert_allclose(results, wanted, rtol=2e-3, atol=1e-4 * np.abs(wanted).max(), err_msg=name)


# ------------------------------------------------------------------------------------------------------------
#  Kernels and hard input
# ------------------------------------------------------------------------------------------------------------


def test_no_kernel_is_compiled_after_the_first_steps():
    """Neither other views, rates and cubes nor other numbers of Gaussians may ask for new code.

    Nor may the place of an array in memory: a panel of odd size and views that come up late would tell.
    """
    scan = tiny_scan(geometry(11, nDetector=(29, 31)))
    method = SHORT.changed(n=61, iterations=24, densify_from=0, densify_every=4, loss_scale='dynamic')
    fresh, sizes = {}, {}

    def progress(done, gaussians, **_):
        history = dr.kernel_history([dr.KernelType.JIT])
        fresh[done] = [k['hash'] for k in history if not k['cache_hit'] or k['cache_disk']]
        sizes[done] = gaussians

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        run(scan, method, progress=progress)
    # Two steps, a densification at the fourth, and one step with its result.
    assert len({sizes[i] for i in (5, 9, 13, 17, 21)}) > 2
    assert not {i: len(hashes) for i, hashes in fresh.items() if i > 5 and hashes}


@pytest.mark.parametrize(
    'changes, masked',
    [
        (dict(loss_scale='dynamic', batch=2), True),
        (dict(loss_scale='statistic'), False),
        pytest.param(dict(loss_scale='dynamic', batch=2), False, marks=pytest.mark.thorough),
        pytest.param(dict(loss_scale='statistic'), True, marks=pytest.mark.thorough),
    ],
)
def test_replayed_steps_are_the_traced_ones(scan, changes, masked, sums_in_order):
    """They agree to the last bit, through densifications."""
    method = SHORT.changed(iterations=20, densify_from=0, densify_every=5, **changes)
    if masked:
        scan = replace(scan, valid=np.random.default_rng(0).random(scan.projections.shape) > 0.1)
    actual = []
    for frozen in (False, True):
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, frozen):
            actual.append(run(scan, method).state)
    traced, replayed = actual
    assert len(traced) != 0 and len(traced) == len(replayed)
    for name, values in traced.values.items():
        assert np.array_equal(values, replayed.values[name]), name
    assert np.array_equal(traced.gradient, replayed.gradient) and np.array_equal(traced.visits, replayed.visits)


def test_a_fit_that_loses_everything_says_so(scan):
    with pytest.raises(InputError, match='every Gaussian was pruned'):
        run(scan, SHORT.changed(prune_density=1e3))


def test_empty_projections_are_refused(scan):
    empty = Scan(scan.geometry, np.zeros_like(scan.projections))
    with pytest.raises(InputError, match='nothing to fit'):
        run(empty, SHORT)


@pytest.mark.parametrize('n', [1, 2])
def test_very_few_gaussians(scan, n):
    fitted = run(scan, SHORT.changed(iterations=14, n=n))
    assert len(fitted.state) >= 1 and all(np.isfinite(v).all() for v in fitted.state.values.values())


class OnePlace(Points):
    """All points in the middle."""

    name = 'one place'

    def cloud(self, *arguments):
        cloud = super().cloud(*arguments)
        return StartingCloud(0 * cloud.points, cloud.density, cloud.spacing)


def test_all_gaussians_in_one_place(scan):
    fitted = run(scan, SHORT.changed(start='one place', n=30, iterations=14))
    assert all(np.isfinite(v).all() for v in fitted.state.values.values())


def test_several_views_a_step(scan):
    fitted = run(scan, SHORT.changed(iterations=6, batch=3))
    assert fitted.history[-1]['loss'] < fitted.history[0]['loss']


def test_values_of_invalid_pixels_do_not_count(scan):
    valid = np.zeros(scan.projections.shape, bool)
    valid[:, :4] = True
    few = SHORT.changed(values_per_gaussian=5).bounded(replace(scan, valid=valid))
    assert few.densify.max_gaussians == valid.sum() // 5


def test_total_variation_beside_more_views(scan):
    """Beyond `tv_views` views, n steps of one view each have no more of it; limits that are applied again change nothing."""
    method = SHORT.changed(lambda_tv=0.3, tv_views=2)
    actual = method.bounded(scan)
    assert len(scan) == 3 and actual.loss.lambda_tv == pytest.approx(0.2)
    assert actual.bounded(scan) == actual
    for other in (method.changed(tv_views=3), method.changed(tv_views=0)):
        assert other.bounded(scan).loss.lambda_tv == 0.3


def test_rates_in_lists(scan):
    """Rates may be lists, as in JSON."""
    rates, corrections = replace(SHORT.rates, rate_centre=[1e-3, 1e-4]), replace(SHORT.corrections, rate_pose=[0, 0])
    assert rates.rate_centre == (1e-3, 1e-4)
    run(scan, replace(SHORT.changed(iterations=1), rates=rates, corrections=corrections))


def test_fits_in_several_threads():
    """They take turns, because at once in Dr.Jit they would wait for each other for ever."""
    code = """
import concurrent.futures, numpy as np, lingo_mi as lm
g = lm.Geometry.cone(DSO=100, DSD=150, nDetector=12, dDetector=3, nVoxel=10, dVoxel=2, angles=lm.circular(4))
scan = lm.simulate(lm.phantom('foot', size=10).data, g, progress=False).train
with concurrent.futures.ThreadPoolExecutor(3) as pool:
    fits = [pool.submit(lm.fit, scan, iterations=12, n_points=80, progress=False) for _ in range(2)]
    image = lm.project(np.ones((1, 3)), np.ones((1, 3)), [[0, 0, 0, 1.0]], [1.0], g)
    print(np.abs(fits[0].result().volume() - fits[1].result().volume()).max() < 1e-3, image.shape)
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and done.stdout.split() == ['True', '(4,', '12,', '12)'], done.stderr[-2000:]


def test_progress_shows_the_absolute_measures(scan):
    shown, values = [], dict(psnr_2d=3.0, psnr_3d=4.0, psnr_3d_r2=5.0)

    def progress(_, **fields):
        shown.append({k: v for k, v in fields.items() if k.startswith('psnr')})

    run(scan, SHORT.changed(iterations=2), measure=lambda fit: values, progress=progress)
    assert shown[-1] == dict(psnr_2d=3.0, psnr_3d=4.0)
