"""The baselines by alpha compositing: radiance, starts, densification, fits of tiny scans, and what they leave behind."""

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.checkpoints import contents, rewrite
from helpers.fits import assert_equal_states, error_of, geometry, stop_at, tiny_scan
from helpers.script import FIT, fit
from helpers.script import run as run_script
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.densify import clone, prune, reset_opacity, split
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.by_name import METHODS
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.models.alpha import harmonics, scene_radius
from lingo_mi.fitting.state import activate, start
from lingo_mi.projectors.radiance import radiance_towards
from lingo_mi.projectors.view import View, vector64
from lingo_mi.storage import output_folder

ALPHA = '3dgs', 'xgaussian'
SHORT = dict(
    iterations=40,
    densify_from=5,
    densify_every=6,
    densify_until=30,
    reset_every=15,
    densify_threshold=2e-4,
    sh_every=10,
    max_gaussians=400,
)


def short(name):
    """A method of 40 steps, with rates that get somewhere in so few."""
    points = dict(n_points=100) if name == '3dgs' else {}
    return METHODS[name].changed(**SHORT, **points, rate_opacity=(5e-2, 5e-2), rate_radiance=(2e-2, 2e-2))


@pytest.fixture(scope='module', params=ALPHA)
def whole(request, scan):
    """The method of an uninterrupted fit, and the fit."""
    method = short(request.param)
    return method, run(scan, method, seed=3)


# ------------------------------------------------------------------------------------------------------------
#  Radiance and starts
# ------------------------------------------------------------------------------------------------------------


def towards(directions, mode='cone'):
    """A view, and Gaussians to which its rays run along the directions [N, 3]; rays of a parallel beam run along the first."""
    view = View.of(geometry(mode=mode).normalised_rays(), 0, 8, 8)
    if mode == 'parallel':
        view.source = vector64(directions[0])
        return mi.Point3f(0, 0, 0), view
    source = np.array([view.source[i].numpy()[0] for i in range(3)])
    return mi.Point3f(*(mi.Float(np.float32(c)) for c in (source + 3 * directions).T)), view


def basis(directions, mode='cone'):
    """The sixteen spherical harmonics as `seen` uses them, [16, N]."""
    centre, view = towards(directions, mode)
    values = []
    for index in range(16):
        unit = [dr.full(mi.Float, 0.2 * (i == index), len(directions)) for i in range(16)]  # small enough not to be cut
        values.append((radiance_towards(centre, view, unit[0], mi.ArrayXf(*unit[1:])).numpy() - 0.5) / 0.2)
    return np.array(values)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_harmonics_of_degree_0_and_1(mode):
    """They have 3DGS's order and signs: (-y, z, -x)."""
    d = np.array([0.36, -0.48, 0.8])
    c = np.sqrt(3 / (4 * np.pi))
    expected = [1 / np.sqrt(4 * np.pi), -c * d[1], c * d[2], -c * d[0]]
    np.testing.assert_allclose(basis(d[None], mode)[:4, 0], expected, atol=1e-5)


def test_harmonics_are_orthonormal():
    n = 20_000
    z = (np.arange(n) + 0.5) / n * 2 - 1
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    d = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    values = basis(d)
    np.testing.assert_allclose(4 * np.pi * values @ values.T / n, np.eye(16), atol=1e-3)


def test_radiance_is_never_negative_and_a_sigmoid_without_harmonics():
    centre, view = towards(np.array([[0, 0, 1]]))
    black = radiance_towards(centre, view, mi.Float(-9), mi.ArrayXf(mi.Float(0), mi.Float(0), mi.Float(0)))
    np.testing.assert_array_equal(black.numpy(), 0)
    np.testing.assert_allclose(
        radiance_towards(centre, view, mi.Float(np.float32([-1, 0, 2]))).numpy(),
        1 / (1 + np.exp([1, 0, -2])),
        rtol=1e-6,
    )


def test_start_is_half_grey():
    for name in ALPHA:
        forward = METHODS[name].forward
        state = start(np.zeros((3, 3)), np.full(3, 0.1), None, forward)
        np.testing.assert_allclose(activate(state, forward)[3], 0.1, rtol=1e-6)
        raw, more = harmonics(state.values)
        assert not raw.any() and not more.any()
    assert more.shape == (3, 0)


def test_scene_radius():
    g = geometry(4, angles=np.radians([0, 90, 180, 270]))
    assert abs(scene_radius(g) - 1.1 * 500 * g.grid.scale) < 1e-6
    assert scene_radius(replace(g, angles=g.angles[:1])) == scene_radius(replace(g, mode='parallel')) == 1


# ------------------------------------------------------------------------------------------------------------
#  Densification
# ------------------------------------------------------------------------------------------------------------

CONTROL, FORWARD = METHODS['3dgs'].densify, METHODS['3dgs'].forward


def some_state(n=12):
    rng = np.random.default_rng(0)
    state = start(rng.uniform(-0.9, 0.9, (n, 3)), rng.uniform(0.02, 0.2, n), None, FORWARD)
    state.values['opacity'][:] = rng.normal(0, 3, (n, 1))
    for group in (state.values, state.first, state.second):
        for name in ('opacity', 'harmonics'):
            group[name] += rng.random(group[name].shape, np.float32)
    return state


def test_clones_and_halves_keep_the_opacity():
    state = some_state()
    chosen = np.arange(12) % 3 == 0
    copied = clone(state, chosen, FORWARD)
    halved = split(state, chosen, FORWARD, np.random.default_rng(0))
    for name in ('opacity', 'radiance', 'harmonics'):
        np.testing.assert_array_equal(
            copied.values[name], np.concatenate([state.values[name], state.values[name][chosen]])
        )
        np.testing.assert_array_equal(halved.values[name][8:], state.values[name][chosen].repeat(2, 0))
        assert not copied.first[name][12:].any() and not halved.second[name][8:].any()
    np.testing.assert_allclose(
        activate(halved, FORWARD)[1][8:], activate(state, FORWARD)[1][chosen].repeat(2, 0) / 1.6, rtol=1e-5
    )


def test_the_faint_and_the_large_vanish_and_those_outside_stay():
    state = some_state(4)
    state.values['opacity'][:, 0] = [-5.4, -5.2, 3, 3]  # 0.0045 and 0.0055
    state.values['centre'][1] = 7
    state.values['scale'][2] = 2
    np.testing.assert_array_equal(
        prune(state, CONTROL, FORWARD, np.ones(3)).values['centre'], state.values['centre'][1:]
    )
    np.testing.assert_array_equal(
        prune(state, CONTROL, FORWARD, np.ones(3), 0.5).values['centre'], state.values['centre'][[1, 3]]
    )


def test_reset_lowers_opacities_alone():
    state = some_state()
    after = reset_opacity(state)
    np.testing.assert_allclose(activate(after, FORWARD)[3], np.minimum(activate(state, FORWARD)[3], 0.01), rtol=1e-5)
    assert not after.first['opacity'].any() and not after.second['opacity'].any()
    for name in ('centre', 'radiance', 'harmonics'):
        np.testing.assert_array_equal(after.values[name], state.values[name])
        np.testing.assert_array_equal(after.second[name], state.second[name])
    assert state.first['opacity'].all()  # the given one is as it was


# ------------------------------------------------------------------------------------------------------------
#  Fits
# ------------------------------------------------------------------------------------------------------------


def test_the_fit_descends(scan, whole):
    method, fitted = whole
    before = run(scan, method.changed(iterations=1), seed=3)
    assert error_of(fitted, scan) < 0.7 * error_of(before, scan)
    assert fitted.state.born.any() and len(fitted.state) <= 400
    assert all(np.isfinite(v).all() for v in fitted.state.values.values())
    assert fitted.cloud() is None
    with pytest.raises(InputError, match='has no volume'):
        fitted.volume()


@pytest.mark.parametrize('stop', [14, pytest.param(15, marks=pytest.mark.thorough), 33])
def test_resumed_fit_is_the_same_fit(scan, whole, tmp_path, stop, variant):
    """It is stopped before a reset of the opacities, right after it, or after the densification."""
    method, fitted = whole
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, method, seed=3, path=path, progress=stop_at(stop))
    resumed = run(scan, method, seed=3, path=path, resume=True)
    if variant.startswith('llvm'):
        assert_equal_states(resumed.state, fitted.state)
    else:
        assert len(resumed.state) == len(fitted.state)


def test_the_method_stays_as_it_was_given(scan, whole):
    """Its lengths stay in units of the radius, so the method of a fit makes the same fit again."""
    method, fitted = whole
    for name in ('rate_centre', 'split_size', 'prune_size'):
        assert fitted.method.flat()[name] == method.flat()[name]


def test_checkpoint_of_another_method_is_refused(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    method = short('3dgs').changed(iterations=1)
    run(scan, method, path=path)
    for other in (R2().changed(iterations=1), method.changed(sh_degree=0)):
        with pytest.raises(InputError, match='other values of (the method|.*sh_degree)'):
            run(scan, other, path=path, resume=True)


def test_degrees_join_one_by_one(scan):
    method = short('3dgs').changed(densify_until=0, iterations=25)
    raw = run(scan, method).state.values['harmonics']
    assert np.abs(raw[:, :3]).max() > np.abs(raw[:, 3:8]).max() > 0 and not raw[:, 8:].any()


def test_no_kernel_is_compiled_after_the_first_steps():
    """Neither densification, resets and degrees nor other views may ask for new code."""
    scan = tiny_scan(geometry(11, nDetector=(29, 31)))
    method = short('3dgs').changed(iterations=24, densify_from=0, densify_every=4, reset_every=8, sh_every=7)
    fresh, sizes = {}, set()

    def progress(done, gaussians, **_):
        history = dr.kernel_history([dr.KernelType.JIT])
        fresh[done] = sum(not k['cache_hit'] or k['cache_disk'] for k in history)
        sizes.add(gaussians)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        run(scan, method, progress=progress)
    assert len(sizes) > 2 and fresh[1] > 0 and not any(n for done, n in fresh.items() if done > 5)


def test_it_may_start_where_other_methods_do(scan):
    """It may start from points with densities, which do not count."""
    fitted = run(scan, short('3dgs').changed(start='edges', n_points=80, iterations=10))
    assert len(fitted.checkpoint.arrays['initial']) == 80 and fitted.info['method'] == 'edges'
    assert fitted.history[-1]['loss'] < fitted.history[0]['loss']


def test_fan_beam():
    """With one row and one slice, nothing leaves the plane."""
    scan = tiny_scan(geometry(3, nDetector=(1, 48), dDetector=(8.0, 8.0), nVoxel=(32, 32, 1)), flat=True)
    method = short('xgaussian').changed(iterations=20, cuboid_step=4)
    fitted = run(scan, method)
    assert not fitted.state.values['centre'][:, 2].any()
    assert fitted.history[-1]['loss'] < fitted.history[0]['loss']


@pytest.mark.parametrize(
    'name, change, message',
    [
        ('3dgs', dict(normalise=False), 'normalise'),
        ('3dgs', dict(lambda_tv=0.05), "unknown setting 'lambda_tv'"),
        ('3dgs', dict(fit_air='view'), "unknown setting 'fit_air'"),
        ('3dgs', dict(rate_pose=(1e-3, 1e-3)), "unknown setting 'rate_pose'"),
        ('xgaussian', dict(effects='model'), "unknown setting 'effects'"),
        ('3dgs', dict(densify='halve'), 'densify=halve is for Gaussians with densities'),
        ('r2', dict(start='cuboid'), 'start=cuboid makes no densities'),
        ('r2', dict(render='alpha'), "unknown setting 'render'"),
        ('r2', dict(densify='opacities'), 'densify=opacities is for Gaussians with opacities'),
        ('3dgs', dict(sh_degree=4), 'sh_degree'),
        ('xgaussian', dict(cuboid_step=0), 'cuboid_step'),
        ('3dgs', dict(reset_every=-1), 'reset_every'),
        ('3dgs', dict(sh_every=0), 'sh_every'),
        ('fast', dict(reset_every=5), "unknown setting 'reset_every'"),
    ],
)
def test_bad_combinations(name, change, message):
    with pytest.raises(InputError, match=message) as caught:
        METHODS[name].changed(**change)
    assert '\n' not in str(caught.value)


# ------------------------------------------------------------------------------------------------------------
#  Results
# ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def result(scene):
    """The folder of a fit to four of eight views, in place of an earlier result, and the text printed."""
    folder = scene.parent / 'alpha'
    folder.mkdir()
    earlier = 'volume.nii.gz', 'result.xml'
    output_folder.begin(folder, earlier)
    for stale in earlier:
        (folder / stale).write_text('of an earlier fit')
    code, out, err = fit(
        scene,
        '--method',
        '3dgs',
        '--views',
        '4',
        '--iterations',
        '60',
        '--force',
        '--out',
        folder,
        '-D',
        'n_points=300',
        '-D',
        'rate_radiance=0.02',
        report=True,
    )
    assert code == 0, err
    return folder, out


def test_what_a_fit_leaves(result):
    folder, out = result
    assert sorted(p.name for p in folder.iterdir()) == [
        '.lingo_mi.json',
        'checkpoint.npz',
        'gaussians.ply',
        'metrics.json',
        'report.html',
        'report.png',
        'views',
    ]
    assert 'result.xml' not in out and 'volume  ' not in out
    metrics = json.loads((folder / 'metrics.json').read_text())
    assert metrics['psnr_3d'] is None and metrics['ssim_3d'] is None
    assert metrics['psnr_2d'] > metrics['history'][0]['psnr_2d'] + 2
    assert 'makes no volume' in (folder / 'report.html').read_text()


def test_mitsuba_reads_the_cloud_as_3dgs(result, scene):
    """Its `ellipsoids` shape knows 3DGS's columns; the checkpoint has the same values."""
    folder, _ = result
    params = mi.traverse(mi.load_dict(dict(type='ellipsoids', filename=str(folder / 'gaussians.ply'))))
    with np.load(folder / 'checkpoint.npz') as stored:
        opacity, raw = 1 / (1 + np.exp(-stored['values.opacity'][:, 0])), stored['values.radiance']
        rest, centre = stored['values.harmonics'], stored['values.centre']
    np.testing.assert_allclose(params['opacities'].numpy(), opacity, rtol=1e-5)
    colours = params['sh_coeffs'].numpy().reshape(len(raw), 16, 3)
    np.testing.assert_allclose(colours, np.concatenate([raw, rest], 1)[:, :, None].repeat(3, 2), rtol=1e-6)
    np.testing.assert_allclose(params['data'].numpy().reshape(-1, 10)[:, :3], centre * 12, rtol=1e-5)  # 24 mm are 2


def test_missing_views_come_from_the_checkpoint(result, scene, tmp_path):
    from lingo_mi.completion.views import complete_views, fitted_views
    from lingo_mi.scene.load import load_scene
    from lingo_mi.scene.simulate import take_scan

    folder, _ = result
    dataset = take_scan(load_scene(scene))
    fitted = Fit.load(folder / 'checkpoint.npz')
    whole = complete_views(fitted_views(dataset.train, fitted.nominal_geometry), fitted, 8)
    expected = dataset.train.projections[1::2]  # the views that the fit has not seen
    projections = whole.projections[4:]
    assert np.linalg.norm(projections - expected) < 0.5 * np.linalg.norm(expected)
    np.testing.assert_allclose(whole.geometry.angles[4:], dataset.train.geometry.angles[1::2])
    reconstruct = FIT.with_name('reconstruct.py')
    complete_it = '--complete', folder / 'checkpoint.npz', '--views', '8', '--out', tmp_path / 'v.nii'
    code, text, err = run_script(reconstruct, scene, *complete_it)
    assert code == 0 and 'of 8 views' in text, err
    code, _, err = run_script(
        reconstruct, scene, '--algorithm', 'voxelize', *complete_it[:2], '--out', tmp_path / 'w.nii'
    )
    assert code == 2 and 'has no volume' in err


def test_damaged_checkpoints(scan, tmp_path):
    path = tmp_path / 'r2.npz'
    run(scan, R2().changed(start='masks', iterations=1, n_points=50, normalise=True, tv_size=8), path=path)
    content = contents(path)
    extra = json.loads(str(content['extra']))
    flat = short('3dgs').flat()
    for damaged in (
        [],
        {},
        extra | dict(method='3dgs'),
        extra | dict(settings=flat),
        extra | dict(method='3dgs', settings=flat),
        extra | dict(settings=3),
        {k: v for k, v in extra.items() if k != 'scanner'},
    ):
        rewrite(path, content, damaged)
        with pytest.raises(InputError, match='not a checkpoint'):
            Fit.load(path)


def test_help_names_every_method():
    code, text, _ = run_script(FIT, '--help')
    assert code == 0 and all(name in text for name in METHODS)


def test_bad_combination_on_the_command_line(scene, tmp_path):
    code, _, err = fit(scene, '--method', 'r2', '--start', 'random', '--out', tmp_path / 'a')
    assert (
        code == 2
        and err.count('\n') == 1
        and '--start random makes no densities' in err
        and not list(tmp_path.iterdir())
    )


def test_a_radiance_without_directions_as_a_harmonic():
    """It is 1/2 plus the coefficient times the harmonic of degree 0, 1 / (2 sqrt(pi))."""
    raw = np.array([[-3.0], [0.0], [2.0]])
    degree0, more = harmonics({'radiance': raw})
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * degree0, 1 / (1 + np.exp(-raw[:, 0])), rtol=1e-12)
    assert more.shape == (3, 0)
