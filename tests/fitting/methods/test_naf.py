"""A fit of a small neural field: it learns, resumes to the bit, compiles nothing late, is kept, and refuses what it must."""

import contextlib
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from helpers.checkpoints import contents, rewrite
from helpers.fields import SMALL
from helpers.fits import assert_equal_states, error_of, geometry, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_threads
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field import field_step
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods import naf
from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.run import run_algorithm


@pytest.fixture
def one_thread(sums_in_order):
    """Run in one thread, since sums of derivatives depend on the order in which threads take their parts."""
    before = dr.thread_count()
    use_threads(1)
    yield
    use_threads(before)


def fit(scan, method=SMALL, **options):
    return run(scan, method, seed=3, **options)


@pytest.fixture(scope='module')
def learnt():
    """A fit of ten views, of a few seconds."""
    scan = tiny_scan(geometry(10))
    method = SMALL.changed(
        iterations=300, field_levels=6, field_entries=2**13, field_width=16, field_samples=48, field_rays=128
    )
    return scan, fit(scan, method)


def test_it_learns_the_object(learnt):
    scan, fitted = learnt
    between = geometry(10, angles=scan.geometry.angles + np.radians(9))
    for g in (scan.geometry, between):
        assert error_of(fitted, tiny_scan(g)) < 0.07  # 0.034 and 0.036
    parallel = tiny_scan(geometry(1, mode='parallel', nDetector=(64, 64), dDetector=(8.0, 8.0)))
    mass = parallel.projections.sum(dtype=float) * 8**2  # of the object: the integral over the panel
    assert fitted.volume().sum(dtype=float) * 8**3 == pytest.approx(mass, rel=0.03)


@pytest.mark.parametrize('factor', [pytest.param(0.02, marks=pytest.mark.thorough), 50])
def test_it_learns_densities_of_any_unit(factor, learnt):
    """Densities may be as in matter, about 0.02 per mm, or beyond 1, which the published form cannot reach."""
    scan, fitted = learnt
    scaled = replace(scan, projections=scan.projections * np.float32(factor))
    refitted = fit(scaled, fitted.method.changed(iterations=150))
    assert error_of(refitted, scaled) < 0.2


def test_the_published_start_is_half_the_largest_density(scan):
    method = SMALL.changed(field_start='random', normalise=False)
    begun = method.stepper(scan)
    assert begun.model.volume(DeviceState(begun.begin(0)[0])) == pytest.approx(0.5, abs=0.15)
    assert begun.model.unit == 1


@pytest.mark.thorough
def test_from_half_the_largest_density_the_field_is_lost_at_first(learnt):
    """The field falls to 0, where the sigmoid has no slope. From the scan's mean, as many steps suffice."""
    scan, fitted = learnt
    refitted = fit(scan, fitted.method.changed(field_start='random'))
    assert error_of(refitted, scan) > 5 * error_of(fitted, scan)


def test_unit_and_start_follow_the_scan(scan):
    """The unit is a bound of the densities, and the field starts from their mean along the rays."""
    stepper = SMALL.stepper(scan)
    truth = tiny_scan_volume(scan)
    assert truth.max() < stepper.model.unit < 4 * truth.max()
    begun = stepper.model.volume(DeviceState(stepper.begin(0)[0]))
    assert begun.mean() == pytest.approx(truth.mean(), rel=0.6)


def tiny_scan_volume(scan):
    """The object of `tiny_scan` on the scan's voxels, from projections of a great many views."""
    many = tiny_scan(geometry(60, nDetector=(64, 64), dDetector=(6.0, 6.0)))
    return run_algorithm(many, FDK()).volume


def test_resumed_fit_is_the_same_fit(scan, tmp_path, one_thread):
    path = tmp_path / 'fit.npz'
    whole = fit(scan)
    with pytest.raises(KeyboardInterrupt):
        fit(scan, path=path, progress=stop_at(5))
    again = fit(scan, path=path, resume=True)
    assert_equal_states(again.state, whole.state)
    assert [h['iteration'] for h in again.history] == [h['iteration'] for h in whole.history]
    resumed = Fit.load(path)
    np.testing.assert_array_equal(resumed.volume(), whole.volume())
    np.testing.assert_array_equal(resumed.render(scan.geometry), whole.render(scan.geometry))


def test_a_search_leaves_the_steps_as_they_are(tmp_path, one_thread):
    """The fit that follows a search for the step to stop at has the steps of a fit without one."""
    scan, path = tiny_scan(geometry(6)), tmp_path / 'fit.npz'
    searched = fit(scan, SMALL.changed(iterations=8, stop='on', stop_every=2, stop_patience=2))
    method = SMALL.changed(iterations=8, stop='off')
    with contextlib.suppress(KeyboardInterrupt):
        fit(scan, method, path=path, progress=stop_at(searched.steps))
    plain = Fit.load(path)
    for name, values in searched.state.values.items():
        np.testing.assert_array_equal(values, plain.state.values[name])


def test_another_seed_is_another_fit(scan):
    a, b = (run(scan, SMALL.changed(iterations=1), seed=s) for s in (1, 2))
    assert not np.array_equal(a.state.values['features'], b.state.values['features'])


def test_a_step_descends_along_the_derivatives_of_its_loss(scan):
    """Two views in a step: the loss is their mean, and so are its derivatives."""
    method = SMALL.changed(batch=2, iterations=1)
    gradients = {}

    def take(state, actual, *_):
        gradients.update({k: g.numpy() for k, g in actual.items()})

    losses = []
    for views in ([0, 1], [0], [1]):
        stepper = method.stepper(scan)
        state = DeviceState(stepper.begin(0)[0])
        rng = np.random.default_rng(5)
        if views == [1]:
            stepper._pixels(0, rng), rng.random(64 * 24, np.float32)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(field_step, 'adam_step', take)
            losses.append((float(stepper.step(state, views, 0, rng)[0]), dict(gradients)))
    (both, of_both), (first, of_first), (second, of_second) = losses
    assert both == pytest.approx((first + second) / 2, rel=1e-5)
    for name, gradient in of_both.items():
        mean = (of_first[name] + of_second[name]) / 2
        np.testing.assert_allclose(gradient, mean, atol=1e-5 * np.abs(mean).max())


def test_rays_are_of_valid_pixels_behind_the_object(scan):
    valid = np.random.default_rng(0).random(scan.projections.shape) > 0.5
    stepper = SMALL.stepper(replace(scan, valid=valid))
    chosen = np.unique(np.concatenate([stepper._pixels(1, np.random.default_rng(i)) for i in range(50)]))
    allowed = np.flatnonzero((valid & (scan.projections > 0))[1])
    np.testing.assert_array_equal(chosen, allowed)


def test_views_without_signal_or_valid_pixels(scan):
    projections, valid = scan.projections.copy(), np.ones(scan.projections.shape, bool)
    projections[0], valid[1] = 0, False
    stepper = SMALL.stepper(replace(scan, projections=projections, valid=valid))
    assert len(stepper._pixels(0, np.random.default_rng(0))) == 64 and not len(
        stepper._pixels(1, np.random.default_rng(0))
    )
    assert np.isfinite(fit(stepper.scan, SMALL.changed(iterations=6)).volume()).all()


def test_no_kernel_is_compiled_after_the_first_steps():
    scan, fresh = tiny_scan(geometry(5, nDetector=(29, 31))), {}

    def progress(done, **_):
        history = dr.kernel_history([dr.KernelType.JIT])
        fresh[done] = [k['hash'] for k in history if not k['cache_hit'] or k['cache_disk']]

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        fit(scan, progress=progress)
    assert not {i: len(hashes) for i, hashes in fresh.items() if i > 2 and hashes}


def test_the_threshold_of_private_copies_is_put_back(scan):
    before = dr.expand_threshold()
    stepper = SMALL.stepper(scan)
    with pytest.raises(IndexError):
        stepper.step(DeviceState(stepper.begin(0)[0]), [99], 0, None)
    assert dr.expand_threshold() == before


@pytest.mark.parametrize(
    'changes, message',
    [
        (dict(lambda_ssim=0.1), "unknown setting 'lambda_ssim'"),
        (dict(lambda_tv=0.1), "unknown setting 'lambda_tv'"),
        (dict(effects='model'), "unknown setting 'effects'"),
        (dict(rate_pose=(1e-4, 1e-5)), "unknown setting 'rate_pose'"),
        (dict(fit_air='view'), "unknown setting 'fit_air'"),
        (dict(loss_scale='dynamic'), "unknown setting 'loss_scale'"),
        (dict(weights='noise'), "unknown setting 'weights'"),
        (dict(start='masks'), "unknown setting 'start'"),
        (dict(field_features=3), 'even'),
        (dict(field_skip=4), 'from 1 to 3'),
        (dict(field_levels=20), 'finest level'),
        (dict(field_samples=0), 'field_samples'),
        (dict(field_cube=0.5), 'field_cube'),
    ],
)
def test_contradictory_options_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        method_of('naf', **changes)


def test_a_field_that_does_not_fit_into_memory_is_refused(scan, monkeypatch):
    monkeypatch.setattr(naf, 'room', lambda: 2**20)
    with pytest.raises(InputError, match='lower field_entries'):
        run(scan, naf.NAF())


@pytest.mark.parametrize(
    'change, message',
    [
        (lambda c: c.update({'values.features': c['values.features'][:-2]}), 'values.features'),
        (lambda c: c.pop('second.network'), 'second.network'),
        (lambda c: c.update({'array.initial': np.zeros((1, 3), np.float32)}), 'neural field'),
    ],
)
def test_damaged_checkpoints_are_refused(scan, tmp_path, change, message):
    path = tmp_path / 'fit.npz'
    fit(scan, SMALL.changed(iterations=1), path=path)
    content = contents(path)
    change(content)
    rewrite(path, content)
    with pytest.raises(InputError, match=message):
        Fit.load(path)


def test_it_has_no_gaussians(learnt):
    fitted = learnt[1]
    assert fitted.cloud() is None and fitted.shares() is None and len(fitted.state) == len(fitted) == 0
    assert fitted.checkpoint.arrays['initial'].shape == (0, 3)
    with pytest.raises(InputError, match='no Gaussians'):
        _ = fitted.gaussians
