"""A fit of a small neural field: it learns, resumes to the bit, compiles nothing late, is kept, and refuses what it must."""

import contextlib
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from helpers.checkpoints import contents
from helpers.fields import SMALL
from helpers.fits import assert_equal_states, error_of, geometry, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_threads
from lingo_mi.fitting import bounded as limits
from lingo_mi.fitting import checkpoint
from lingo_mi.fitting.field import field_step
from lingo_mi.fitting.field.field_step import FieldStepper
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.recipes import settings_of
from lingo_mi.reconstruction.fdk import FDK


@pytest.fixture
def one_thread(sums_in_order):
    """Sums of derivatives take the order in which threads come to their parts."""
    before = dr.thread_count()
    use_threads(1)
    yield
    use_threads(before)


def fit(scan, settings=SMALL, **options):
    return run(scan, settings, initial_cloud(scan, settings), seed=3, **options)


@pytest.fixture(scope='module')
def learnt():
    """A fit of ten views, of a few seconds."""
    scan = tiny_scan(geometry(10))
    settings = SMALL.changed(
        iterations=300, field_levels=6, field_entries=2**13, field_width=16, field_samples=48, field_rays=128
    )
    return scan, fit(scan, settings)


def test_it_learns_the_object(learnt):
    scan, fitted = learnt
    between = geometry(10, angles=scan.geometry.angles + np.radians(9))
    for g in (scan.geometry, between):
        assert error_of(fitted, tiny_scan(g)) < 0.07  # 0.034 and 0.036
    parallel = tiny_scan(geometry(1, mode='parallel', nDetector=(64, 64), dDetector=(8.0, 8.0)))
    mass = parallel.projections.sum(dtype=float) * 8**2  # of the object: the integral over the panel
    assert fitted.volume().sum(dtype=float) * 8**3 == pytest.approx(mass, rel=0.03)


@pytest.mark.parametrize('factor', [0.02, 50])
def test_it_learns_densities_of_any_unit(factor, learnt):
    """Of matter, about 0.02 per mm; and beyond 1, which the published form cannot reach."""
    scan, fitted = learnt
    scaled = replace(scan, projections=scan.projections * np.float32(factor))
    found = fit(scaled, fitted.settings.changed(iterations=150))
    assert error_of(found, scaled) < 0.2


def test_the_published_start_is_half_the_largest_density(scan):
    settings = SMALL.changed(field_start='random', normalise=False)
    begun = FieldStepper(scan, settings)
    state = begun.start(initial_cloud(scan, settings), np.random.default_rng(0))
    assert begun.model.volume(field_step.DeviceState(state)) == pytest.approx(0.5, abs=0.15)
    assert begun.model.unit == 1


def test_from_half_the_largest_density_the_field_is_lost_at_first(learnt):
    """It falls to 0, where the sigmoid has no slope; from the scan's mean, as many steps suffice."""
    scan, fitted = learnt
    found = fit(scan, fitted.settings.changed(field_start='random'))
    assert error_of(found, scan) > 5 * error_of(fitted, scan)


def test_unit_and_start_follow_the_scan(scan):
    """A bound of the densities, and their mean along the rays."""
    stepper = FieldStepper(scan, SMALL)
    truth = tiny_scan_volume(scan)
    assert truth.max() < stepper.model.unit < 4 * truth.max()
    state = stepper.start(initial_cloud(scan, SMALL), np.random.default_rng(0))
    begun = stepper.model.volume(field_step.DeviceState(state))
    assert begun.mean() == pytest.approx(truth.mean(), rel=0.6)


def tiny_scan_volume(scan):
    """The object of `tiny_scan` on the scan's voxels, from projections of a great many views."""
    many = tiny_scan(geometry(60, nDetector=(64, 64), dDetector=(6.0, 6.0)))
    return FDK().run(many).volume


def test_resumed_fit_is_the_same_fit(scan, tmp_path, one_thread):
    path = tmp_path / 'fit.npz'
    whole = fit(scan)
    with pytest.raises(KeyboardInterrupt):
        fit(scan, path=path, progress=stop_at(5))
    again = run(scan, SMALL, None, seed=3, path=path)
    assert_equal_states(again.state, whole.state)
    assert [h['iteration'] for h in again.history] == [h['iteration'] for h in whole.history]
    kept = Fitted.from_checkpoint(path)
    np.testing.assert_array_equal(kept.volume(), whole.volume())
    np.testing.assert_array_equal(kept.render(scan.geometry), whole.render(scan.geometry))


def test_a_search_leaves_the_steps_as_they_are(tmp_path, one_thread):
    """The fit that follows a search for the step to stop at has the steps of a fit without one."""
    scan, path = tiny_scan(geometry(6)), tmp_path / 'fit.npz'
    searched = fit(scan, SMALL.changed(iterations=8, stop='on', stop_every=2, stop_patience=2))
    settings = SMALL.changed(iterations=8, stop='off')
    with contextlib.suppress(KeyboardInterrupt):
        fit(scan, settings, path=path, progress=stop_at(searched.steps))
    plain = Fitted.from_checkpoint(path)
    for name, values in searched.state.values.items():
        np.testing.assert_array_equal(values, plain.state.values[name])


def test_another_seed_is_another_fit(scan):
    a, b = (run(scan, SMALL.changed(iterations=1), initial_cloud(scan, SMALL), seed=s) for s in (1, 2))
    assert not np.array_equal(a.state.values['features'], b.state.values['features'])


def test_a_step_descends_along_the_derivatives_of_its_loss(scan):
    """Two views in a step: the loss is their mean, and so are its derivatives."""
    settings = SMALL.changed(batch=2, iterations=1)
    gradients = {}

    def take(state, found, *_):
        gradients.update({k: g.numpy() for k, g in found.items()})

    losses = []
    for views in ([0, 1], [0], [1]):
        stepper, rng = FieldStepper(scan, settings), np.random.default_rng(0)
        state = field_step.DeviceState(stepper.start(initial_cloud(scan, settings), rng))
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
    stepper = FieldStepper(replace(scan, valid=valid), SMALL)
    chosen = np.unique(np.concatenate([stepper._pixels(1, np.random.default_rng(i)) for i in range(50)]))
    allowed = np.flatnonzero((valid & (scan.projections > 0))[1])
    np.testing.assert_array_equal(chosen, allowed)


def test_views_without_signal_or_valid_pixels(scan):
    projections, valid = scan.projections.copy(), np.ones(scan.projections.shape, bool)
    projections[0], valid[1] = 0, False
    stepper = FieldStepper(replace(scan, projections=projections, valid=valid), SMALL)
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
    stepper = FieldStepper(scan, SMALL)
    with pytest.raises(IndexError):
        stepper.step(
            field_step.DeviceState(stepper.start(initial_cloud(scan, SMALL), np.random.default_rng(0))), [99], 0, None
        )
    assert dr.expand_threshold() == before


@pytest.mark.parametrize(
    'changes, said',
    [
        (dict(lambda_ssim=0.1), 'lambda_ssim=0'),
        (dict(lambda_tv=0.1), 'lambda_tv=0'),
        (dict(effects='model'), 'effects=ignore'),
        (dict(rate_pose=(1e-4, 1e-5)), 'rate_pose'),
        (dict(coarse_share=0.5), 'coarse_share'),
        (dict(weights='noise'), 'equal weights'),
        (dict(init='lingo'), "init is 'network'"),
        (dict(field_features=3), 'even'),
        (dict(field_skip=4), 'from 1 to 3'),
        (dict(field_levels=20), 'finest level'),
        (dict(field_samples=0), 'field_samples'),
        (dict(field_cube=0.5), 'field_cube'),
    ],
)
def test_contradictory_settings_are_refused(changes, said):
    with pytest.raises(InputError, match=said):
        settings_of('naf', **changes)


def test_a_field_that_does_not_fit_into_memory_is_refused(scan, monkeypatch):
    monkeypatch.setattr(limits, 'room', lambda: 2**20)
    with pytest.raises(InputError, match='lower field_entries'):
        run(scan, settings_of('naf'), initial_cloud(scan, SMALL))


@pytest.mark.parametrize(
    'change, said',
    [
        (lambda c: c.update({'values.features': c['values.features'][:-2]}), 'values.features'),
        (lambda c: c.pop('second.network'), 'second.network'),
        (lambda c: c.update({'array.initial': np.zeros((1, 3), np.float32)}), 'neural field'),
    ],
)
def test_damaged_checkpoints_are_refused(scan, tmp_path, change, said):
    path = tmp_path / 'fit.npz'
    fit(scan, SMALL.changed(iterations=1), path=path)
    content = contents(path)
    change(content)
    del content['checksum']
    content['checksum'] = np.array(checkpoint._checksum((k, checkpoint._Crc.of(v)) for k, v in content.items()))
    np.savez(path, **content)
    with pytest.raises(InputError, match=said):
        Fitted.from_checkpoint(path)


def test_it_has_no_gaussians(learnt):
    fitted = learnt[1]
    assert fitted.cloud() is None and fitted.shares() is None and len(fitted.state) == 0 and len(fitted.initial) == 0
    with pytest.raises(InputError, match='no Gaussians'):
        fitted.world_gaussians()
