"""The fit on tiny scans: it descends, resumes to the bit, compiles nothing late, and refuses what it must."""

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.checkpoints import contents, write_as_before
from helpers.fits import SHORT, assert_equal_states, error_of, geometry, some_points, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting import bounded as limits
from lingo_mi.fitting import checkpoint, step, view_loss
from lingo_mi.fitting.cloud_model import CloudModel
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.recipes import CLOUDS, METHODS
from lingo_mi.fitting.resume import extensible
from lingo_mi.fitting.state import activate
from lingo_mi.fitting.state import start as start_state
from lingo_mi.fitting.total_variation import random_cube_variation
from lingo_mi.scan import Scan


@pytest.fixture(scope='module')
def whole(scan):
    """An uninterrupted run."""
    return run(scan, SHORT, some_points(scan.geometry), seed=3)


# ------------------------------------------------------------------------------------------------------------
#  Progress
# ------------------------------------------------------------------------------------------------------------


def test_loss_falls(scan, whole):
    losses = [entry['loss'] for entry in whole.history]
    assert [entry['iteration'] for entry in whole.history][-1] == 30
    assert losses[-1] < 0.7 * losses[0]
    before = run(scan, SHORT.changed(iterations=1), some_points(scan.geometry), seed=3)
    assert error_of(whole, scan) < 0.7 * error_of(before, scan)
    assert len(whole.state) > 60 and whole.state.born.any()  # densification did something
    assert all(np.isfinite(v).all() for v in whole.state.values.values())


def test_a_small_scan_bounds_the_number_of_gaussians(scan, whole):
    assert len(whole.state) > 65
    few = SHORT.changed(values_per_gaussian=scan.projections.size / 65, n_points=500, init='lingo')
    assert len(run(scan, few, some_points(scan.geometry), seed=3).state) <= 65
    assert len(initial_cloud(scan, few)) == 65


def test_more_than_the_scan_or_the_memory_has(scan, monkeypatch):
    with pytest.raises(InputError, match='at most the 3 of the scan, not 4'):
        initial_cloud(scan, SHORT.changed(batch=4))
    with pytest.raises(InputError, match='at most the 3 of the scan, not 1000000'):
        run(scan, SHORT.changed(batch=10**6), some_points(scan.geometry))
    monkeypatch.setattr(limits, 'room', lambda: 2**20)
    for settings in (SHORT.changed(init='lingo', n_points=10**8), METHODS['3dgs'].changed(n_points=3000)):
        with pytest.raises(InputError, match='lower n_points'):
            initial_cloud(scan, settings)
    limits.bounded(SHORT.changed(n_points=2000), scan)
    limits.bounded(METHODS['xgaussian'], scan)


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
    coarse_share=(0, 1),
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
    """A fit with settings as far as they may go is a fit, or one line."""
    usual = SHORT.changed(
        iterations=3,
        n_points=60,
        init='r2' if name.startswith('fdk') else 'lingo',
        densify_from=0,
        densify_every=1,
        rate_pose=(1e-3, 1e-3),
        average=0.5,
        max_gaussians=200,
    )
    for value in ENDS[name]:
        settings = usual.changed(**{name: value})
        try:
            fitted = run(scan, settings, initial_cloud(scan, settings), path=tmp_path / 'fit.npz')
        except InputError as error:
            assert '\n' not in str(error) and len(str(error)) < 300
        else:
            assert np.isfinite(fitted.volume()).all() and len(checkpoint.load(tmp_path / 'fit.npz')[0]) > 0


def test_progress_and_measure_are_called(scan):
    steps, measured = [], []
    run(
        scan,
        SHORT.changed(iterations=8),
        some_points(scan.geometry),
        measure=lambda model, state: measured.append(len(state)) or {'psnr2d': 1.0},
        progress=lambda done, loss, gaussians, **rest: steps.append((done, loss(), gaussians, rest)),
    )
    assert [s[0] for s in steps] == list(range(1, 9)) and all(np.isfinite(s[1]) for s in steps)
    assert measured and steps[-1][3] == {'psnr2d': 1.0}


def test_same_seed_same_fit(scan, whole, sums_in_order):
    assert_equal_states(run(scan, SHORT, some_points(scan.geometry), seed=3).state, whole.state)
    other = run(scan, SHORT, some_points(scan.geometry), seed=4).state
    assert len(other) != len(whole.state) or not np.array_equal(other.values['centre'], whole.state.values['centre'])


@pytest.mark.parametrize('method', CLOUDS)
def test_each_method(method, scan):
    settings = METHODS[method].changed(
        iterations=8, n_points=200, densify_from=2, densify_every=3, tv_size=8, fdk_threshold=1e-3
    )
    start = initial_cloud(scan, settings)
    fitted = run(scan, settings, start)
    assert len(fitted.state) > 0 and np.isfinite(error_of(fitted, scan))
    assert fitted.history[-1]['iteration'] == 8
    volume = fitted.volume()
    assert volume.shape == scan.geometry.nVoxel and volume.max() > 0


@pytest.mark.parametrize('birth', ['clone', 'halve'])
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_fan_beam_stays_in_its_plane(mode, birth):
    """One row and one slice: nothing may leave the plane or turn out of it."""
    g = geometry(6, nDetector=(1, 48), dDetector=(8.0, 8.0), nVoxel=(32, 32, 1), mode=mode)
    scan, start = tiny_scan(g, flat=True), some_points(g)
    settings = SHORT.changed(split_size=0.08, birth=birth)
    fitted = run(scan, settings, start)
    assert fitted.state.born.any()  # clones and halves of splits, which are drawn at random
    centre, scale, rotation, _ = activate(fitted.state, fitted.settings)
    assert not centre[:, 2].any() and not rotation[:, :2].any()
    np.testing.assert_allclose(scale[:, 2], 0.08, rtol=1e-5)
    before = run(scan, settings.changed(iterations=1), start)
    assert error_of(fitted, scan) < 0.9 * error_of(before, scan)


@pytest.mark.parametrize('stride', [1, 2, 3])
def test_total_variation_is_of_every_nth_voxel(scan, stride):
    """With so many samples that they fit in one place only, between the first and the last voxels."""
    g = replace(scan.geometry, nVoxel=(13, 13, 7), dVoxel=(20.0, 20.0, 36.0))
    settings = SHORT.changed(tv_stride=stride, tv_size=13, extent=6.0)
    model, start = CloudModel(settings, g, 0.5), some_points(g)
    state = DeviceState(start_state(start.points.astype(np.float32), start.spacing, start.density, settings))
    gaussians = state.gaussians(settings)
    dr.enable_grad(gaussians)
    found = random_cube_variation(gaussians, g, settings, np.random.default_rng(0))[0]
    volume = model.volume(state)[::stride, ::stride, ::stride] / model.unit
    wanted = np.concatenate([np.diff(volume, axis=i).ravel() for i in range(3)])
    np.testing.assert_allclose(found, settings.loss.lambda_tv * np.abs(wanted).mean(), rtol=1e-5)


@pytest.mark.parametrize('batch', [1, 2])
def test_the_dynamic_factor_is_on_the_whole_loss(scan, batch, monkeypatch):
    """On L1, SSIM and total variation alike (paper, section III-C): the step's gradient is the plain one times the factor.

    With a batch of views, the total variation has the mean of their factors.
    """
    factors = iter([3.0, 5.0][:batch])
    monkeypatch.setattr(view_loss, 'loss_scale', lambda image: mi.Float(next(factors)))

    def gradients(views, **changes):
        found = {}
        monkeypatch.setattr(step, 'adam_step', lambda state, gradients, *_: found.update(gradients))
        settings = SHORT.changed(tv_size=9, batch=batch, **changes)
        stepper, start = step.Stepper(scan, settings), some_points(scan.geometry)
        state = DeviceState(stepper.start(start, np.random.default_rng(0)))
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            stepper.step(state, views, 0, np.random.default_rng(7))
        return {name: x.numpy() for name, x in found.items()}

    views = list(range(batch))
    scaled = gradients(views, loss_scale='dynamic')
    both = gradients(views, lambda_tv=0.0, loss_scale='none'), gradients(views, loss_scale='none')
    variation = {name: both[1][name] - both[0][name] for name in scaled}
    single = [gradients([view], lambda_tv=0.0, loss_scale='none') for view in views]
    for name in ('centre', 'density', 'scale'):  # spheres have no rotation
        found = scaled[name]
        wanted = sum(f * one[name] for f, one in zip((3, 5), single)) / batch + (3, 4)[batch - 1] * variation[name]
        assert np.abs(variation[name]).max() > 1e-3 * np.abs(found).max(), name
        np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=1e-4 * np.abs(wanted).max(), err_msg=name)


# ------------------------------------------------------------------------------------------------------------
#  Checkpoints
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('stop', [13, 12])
def test_resumed_fit_is_the_same_fit(scan, whole, tmp_path, stop, sums_in_order):
    """Stopped between densifications or right after one."""
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SHORT, some_points(scan.geometry), seed=3, path=path, progress=stop_at(stop))
    fitted = run(scan, SHORT, None, seed=3, path=path)
    assert_equal_states(fitted.state, whole.state)
    assert [h['iteration'] for h in fitted.history] == [h['iteration'] for h in whole.history]
    np.testing.assert_array_equal(fitted.initial, whole.initial)


def test_other_projections_of_the_same_mean_are_refused(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    settings = SHORT.changed(iterations=3)
    run(scan, settings, some_points(scan.geometry), path=path)
    nearly = replace(scan, projections=scan.projections * np.float32(1 + 1e-6))  # as simulated by another machine
    run(nearly, settings, None, path=path)
    for axis in range(3):
        mirrored = replace(scan, projections=np.flip(scan.projections, axis))
        with pytest.raises(InputError, match='other values of the projections'):
            run(mirrored, settings, None, path=path)


def test_resuming_a_finished_fit_changes_nothing(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    settings = SHORT.changed(iterations=3)
    done = run(scan, settings, some_points(scan.geometry), path=path)
    assert_equal_states(run(scan, settings, None, path=path).state, done.state)


@pytest.fixture
def stored(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    run(scan, SHORT.changed(iterations=2), some_points(scan.geometry), path=path)
    return path


@pytest.mark.parametrize('change', [dict(extent=4.0), dict(iterations=40), dict(rate_scale=(1e-2, 1e-3))])
def test_checkpoint_of_other_settings_is_refused(scan, stored, change):
    with pytest.raises(InputError, match=next(iter(change))):
        run(scan, SHORT.changed(iterations=2).changed(**change), None, path=stored)


def test_checkpoint_of_another_scan_is_refused(scan, stored):
    g, settings = scan.geometry, SHORT.changed(iterations=2)
    for other, what in (
        (scan.subset([0, 1]), 'views'),
        (replace(scan, geometry=replace(g, DSO=g.DSO * 0.9)), 'the geometry'),
        (replace(scan, projections=scan.projections * np.float32(1.01)), 'the projections'),
    ):
        with pytest.raises(InputError, match=f'other values of .*{what};'):
            run(other, settings, None, path=stored)
    almost = replace(scan, projections=scan.projections * np.float32(1 + 1e-6))  # simulated on another machine
    run(almost, settings, None, path=stored)


def test_a_full_disk_leaves_the_earlier_checkpoint(scan, stored, monkeypatch):
    before = stored.read_bytes()

    def savez(file, **_):
        file.write(b'begun')
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, 'savez', savez)
    with pytest.raises(InputError, match='fit.npz: cannot be written'):
        run(scan, SHORT.changed(iterations=2), None, path=stored)
    assert stored.read_bytes() == before and [p.name for p in stored.parent.iterdir()] == [stored.name]


@pytest.mark.parametrize('share', [0, 0.3, 0.95])
def test_truncated_checkpoint_is_refused(scan, stored, share):
    content = stored.read_bytes()
    stored.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InputError, match='not a checkpoint'):
        run(scan, SHORT.changed(iterations=2), None, path=stored)


def test_damaged_checkpoint_is_refused(scan, stored):
    content = bytearray(stored.read_bytes())
    content[len(content) // 3] ^= 0xFF
    stored.write_bytes(bytes(content))
    with pytest.raises(InputError, match='not a checkpoint'):
        run(scan, SHORT.changed(iterations=2), None, path=stored)


def test_absent_checkpoint_is_refused(scan, tmp_path):
    with pytest.raises(InputError, match='no checkpoint'):
        run(scan, SHORT, None, path=tmp_path / 'fit.npz')


# ------------------------------------------------------------------------------------------------------------
#  Kernels and hard input
# ------------------------------------------------------------------------------------------------------------


def test_no_kernel_is_compiled_after_the_first_steps():
    """Neither other views, rates and cubes nor other numbers of Gaussians may ask for new code.

    Nor may the place of an array in memory: a panel of odd size and views that come up late would tell.
    """
    scan = tiny_scan(geometry(11, nDetector=(29, 31)))
    settings = SHORT.changed(iterations=24, densify_from=0, densify_every=4, loss_scale='dynamic')
    fresh, sizes = {}, {}

    def progress(done, gaussians, **_):
        history = dr.kernel_history([dr.KernelType.JIT])
        fresh[done] = [k['hash'] for k in history if not k['cache_hit'] or k['cache_disk']]
        sizes[done] = gaussians

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        run(scan, settings, some_points(scan.geometry, 61), progress=progress)
    # Two steps, a densification at the fourth, and one step with its result.
    assert len({sizes[i] for i in (5, 9, 13, 17, 21)}) > 2
    assert not {i: len(hashes) for i, hashes in fresh.items() if i > 5 and hashes}


@pytest.mark.parametrize('masked', [False, True])
@pytest.mark.parametrize('changes', [dict(loss_scale='dynamic', batch=2), dict(loss_scale='statistic')])
def test_replayed_steps_are_the_traced_ones(scan, changes, masked, sums_in_order):
    """To the last bit, through densifications and with views of two sizes."""
    settings = SHORT.changed(iterations=20, densify_from=0, densify_every=5, coarse_share=0.3, **changes)
    if masked:
        scan = replace(scan, valid=np.random.default_rng(0).random(scan.projections.shape) > 0.1)
    found = []
    for frozen in (False, True):
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, frozen):
            found.append(run(scan, settings, some_points(scan.geometry)).state)
    traced, replayed = found
    assert len(traced) != 0 and len(traced) == len(replayed)
    for name, values in traced.values.items():
        assert np.array_equal(values, replayed.values[name]), name
    assert np.array_equal(traced.gradient, replayed.gradient) and np.array_equal(traced.visits, replayed.visits)


def test_a_fit_that_loses_everything_says_so(scan):
    with pytest.raises(InputError, match='every Gaussian was pruned'):
        run(scan, SHORT.changed(prune_density=1e3), some_points(scan.geometry))


def test_empty_projections_are_refused(scan):
    empty = Scan(scan.geometry, np.zeros_like(scan.projections))
    with pytest.raises(InputError, match='nothing to fit'):
        run(empty, SHORT, some_points(scan.geometry))


@pytest.mark.parametrize('n', [1, 2])
def test_very_few_gaussians(scan, n):
    fitted = run(scan, SHORT.changed(iterations=14), some_points(scan.geometry, n))
    assert len(fitted.state) >= 1 and all(np.isfinite(v).all() for v in fitted.state.values.values())


def test_all_gaussians_in_one_place(scan):
    start = some_points(scan.geometry, 30)
    start = replace(start, points=np.zeros((30, 3)))
    fitted = run(scan, SHORT.changed(iterations=14), start)
    assert all(np.isfinite(v).all() for v in fitted.state.values.values())


def test_several_views_a_step(scan):
    fitted = run(scan, SHORT.changed(iterations=6, batch=3), some_points(scan.geometry))
    assert fitted.history[-1]['loss'] < fitted.history[0]['loss']


# ------------------------------------------------------------------------------------------------------------
#  Results without their scan
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('changes', [{}, dict(average=0.8), dict(rate_pose=(2e-3, 2e-4), effects='ignore')])
def test_a_checkpoint_is_the_fit(scan, tmp_path, changes):
    path = tmp_path / 'fit.npz'
    done = run(scan, SHORT.changed(iterations=8, **changes), some_points(scan.geometry), seed=3, path=path)
    again = Fitted.from_checkpoint(path)
    assert_equal_states(again.state, done.state)
    assert (again.settings, again.unit, again.seed, again.history) == (done.settings, done.unit, 3, done.history)
    np.testing.assert_array_equal(again.initial, done.initial)
    np.testing.assert_allclose(again.volume(), done.volume(), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(again.render(scan.geometry), done.render(scan.geometry), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(again.corrected.rays().source, done.corrected.rays().source, atol=1e-9)
    assert (again.corrected is again.geometry) == ('rate_pose' not in changes)
    np.testing.assert_allclose(again.cloud().density.numpy(), done.cloud().density.numpy(), rtol=1e-6)
    finer = replace(scan.geometry, nVoxel=(16, 16, 16), dVoxel=(16.0, 16.0, 16.0))
    assert again.volume(finer).shape == (16, 16, 16)


def test_an_unfinished_fit_is_its_mean_so_far(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    settings, measured = SHORT.changed(average=0.8, densify_from=100), []
    with pytest.raises(KeyboardInterrupt):
        run(
            scan,
            settings,
            some_points(scan.geometry),
            measure=lambda model, state: measured.append(state.host()) or {},
            progress=stop_at(8),
            path=path,
            at=[8],
        )
    for name, values in Fitted.from_checkpoint(path).state.values.items():
        np.testing.assert_array_equal(values, measured[-1].values[name])


def test_files_that_are_no_fit(scan, stored):
    with pytest.raises(InputError, match='no such file'):
        Fitted.from_checkpoint(stored.with_name('none.npz'))
    content = contents(stored)
    extra = json.loads(str(content['extra']))
    for damaged, message in (
        (extra | dict(effects=True), 'modelled effects'),
        ({k: v for k, v in extra.items() if k != 'unit'}, 'by this version'),
        (extra | dict(settings=extra['settings'] | dict(renamed=1)), "unknown setting 'renamed'"),
    ):
        write_as_before(stored, content, damaged)
        with pytest.raises(InputError, match=message) as caught:
            Fitted.from_checkpoint(stored)
        assert '\n' not in str(caught.value)
    del extra['effects']  # as earlier versions wrote it
    write_as_before(stored, content, extra)
    assert len(Fitted.from_checkpoint(stored).state) == len(content['born'])


def test_what_renews_something_in_shares_of_its_steps_is_not_made_longer(tmp_path):
    """A gain of the views, or scattered light: half of a longer fit is another fit."""
    scan, path = tiny_scan(geometry()), tmp_path / 'checkpoint.npz'
    settings = SHORT.changed(iterations=2, decay_steps=100, fit_gain='view')
    run(scan, settings, some_points(scan.geometry), path=path)
    with pytest.raises(InputError, match='other values of iterations'):
        run(scan, settings.changed(iterations=4), None, path=path)
    assert extensible(SHORT.changed(decay_steps=100)) and not extensible(SHORT.changed(decay_steps=100), scatters=True)


def test_progress_shows_the_absolute_measures(tmp_path):
    """A resumed fit's history may have the measures under their earlier names."""
    scan, path, shown = tiny_scan(geometry()), tmp_path / 'checkpoint.npz', []

    def measured(values):
        return lambda *_: values

    settings = SHORT.changed(iterations=2, decay_steps=100)
    run(
        scan, settings, some_points(scan.geometry), measure=measured(dict(psnr_3d=1.0, psnr_3d_absolute=2.0)), path=path
    )
    longer = settings.changed(iterations=3)
    again = run(
        scan,
        longer,
        None,
        measure=measured(dict(psnr_2d=3.0, psnr_3d=4.0, psnr_3d_r2=5.0)),
        progress=lambda _, **fields: shown.append({k: v for k, v in fields.items() if k.startswith('psnr')}),
        path=path,
    )
    assert shown[-1] == dict(psnr_2d=3.0, psnr_3d=4.0)
    assert {k: v for k, v in again.history[0].items() if k.startswith('psnr')} == dict(psnr_3d_r2=1.0, psnr_3d=2.0)
    assert Fitted.from_checkpoint(path).history == again.history


def test_steps_of_an_unfinished_fit(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SHORT, some_points(scan.geometry), path=path, progress=stop_at(5))
    assert Fitted.from_checkpoint(path).steps == 5
    assert run(scan, SHORT, None, path=path).steps == Fitted.from_checkpoint(path).steps == 30


@pytest.mark.parametrize('what', ['valid pixels', 'effects of the scan'])
def test_another_mask_or_other_effects_are_refused(scan, tmp_path, what):
    path, settings = tmp_path / 'fit.npz', SHORT.changed(iterations=3)
    valid = np.ones(scan.projections.shape, bool)
    valid[0, :4] = False
    detector = Detector.of(**Detector.DEFAULTS | dict(photons=1e4))
    change = dict(valid=valid) if what == 'valid pixels' else dict(effects=Effects(detector=detector))
    run(replace(scan, **change), settings, some_points(scan.geometry), path=path)
    run(replace(scan, **change), settings, None, path=path)
    with pytest.raises(InputError, match=f'other values of .*the {what};'):
        run(scan, settings, None, path=path)


def test_values_of_invalid_pixels_do_not_count(scan):
    valid = np.zeros(scan.projections.shape, bool)
    valid[:, :4] = True
    few = limits.bounded(SHORT.changed(values_per_gaussian=5), replace(scan, valid=valid))
    assert few.densification.max_gaussians == valid.sum() // 5


def test_total_variation_beside_more_views(scan):
    """No more of it in n steps, one a view, from `tv_views` on; once only, when limits meet limits."""
    settings = SHORT.changed(lambda_tv=0.3, tv_views=2)
    found = limits.bounded(settings, scan)
    assert len(scan) == 3 and found.loss.lambda_tv == pytest.approx(0.2)
    assert limits.bounded(found, scan) == found
    for other in (settings.changed(tv_views=3), settings.changed(tv_views=0)):
        assert limits.bounded(other, scan).loss.lambda_tv == 0.3


def test_rates_in_lists(scan):
    """As JSON has them."""
    adam = replace(SHORT.adam, rate_centre=[1e-3, 1e-4], rate_pose=[0, 0])
    assert adam.rate_centre == (1e-3, 1e-4)
    run(scan, replace(SHORT.changed(iterations=1), adam=adam), some_points(scan.geometry))


def test_fits_in_several_threads():
    """They take turns: in Dr.Jit at once, they would wait for each other for ever."""
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
