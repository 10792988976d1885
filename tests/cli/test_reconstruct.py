"""scripts/reconstruct.py from end to end on a tiny scene, the two-stage way, and bad input in one line."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import nibabel
import numpy as np
import pytest

from helpers.effect_parts import detector, tube
from helpers.effects import physics
from helpers.same import assert_same, assert_same_volume
from helpers.script import FIT, SCENE, fit, run
from lingo_mi.common.errors import InputError
from lingo_mi.completion import views
from lingo_mi.completion.views import as_corrected, complete_views, fitted_views, without_effects
from lingo_mi.effects.focal_spot import FocalSpot
from lingo_mi.effects.forward import Effects
from lingo_mi.files.ply import write_ply
from lingo_mi.files.scans import write_scan
from lingo_mi.fitting.fit import load_fit
from lingo_mi.fitting.measure import volume_quality
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.scene_file import write_scene
from lingo_mi.geometry import CircularGeometry, Grid, PosedGeometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import compared, psnr_3d, psnr_3d_r2
from lingo_mi.projectors.objects import find_objects
from lingo_mi.reconstruction import ASDPOCS, FDK, SART, Best
from lingo_mi.reconstruction.refined import structure
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.wide_pixels import excess_width
from lingo_mi.scan import Scan
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import render_objects, take_scan

RECONSTRUCT = FIT.with_name('reconstruct.py')


@pytest.fixture(scope='module')
def dataset(scene):
    return take_scan(load_scene(scene))


@pytest.fixture(scope='module')
def fitted(scene):
    """result.xml of a short fit to four of the eight views."""
    folder = scene.parent / 'fitted'
    code, _, err = fit(scene, '--views', '4', '--iterations', '40', '--out', folder, '-D', 'n_points=300')
    assert code == 0, err
    return folder / 'result.xml'


def load(path):
    return nibabel.load(path).get_fdata(dtype=np.float32)


@pytest.mark.parametrize(
    'algorithm, options',
    [
        ('fdk', ['filter=hann']),
        ('sart', ['niter=2', 'OrderStrategy=angularDistance']),
        ('os-sart', ['niter=2', 'blocksize=3', 'noneg=false']),
        ('sirt', ['niter=2']),
        ('cgls', ['niter=3', 'tol=0.01']),
        ('asd-pocs', ['niter=2', 'tviter=3', 'noneg=true', 'maxl2err=5']),
        ('pls', ['niter=2', 'strength=1e-4', 'upper=5']),
    ],
)
def test_every_algorithm(scene, dataset, tmp_path, algorithm, options):
    out = tmp_path / 'new' / 'volume.nii.gz'
    defined = (a for o in options for a in ('-D', o))
    code, text, err = run(RECONSTRUCT, scene, '--algorithm', algorithm, '--out', out, *defined)
    assert code == 0, err
    shown = [float(x) for x in re.findall(r'PSNR (\S+) dB', text)]
    volume, truth = load(out), dataset.volume / 2
    assert abs(shown[0] - psnr_3d(volume, dataset.volume)) < 0.006
    assert abs(shown[1] - psnr_3d_r2(volume, dataset.volume)) < 0.006 and shown[1] > 10
    lines = volume_quality(
        compared(volume / 2, truth)
    ).splitlines()  # in another unit the first line stays, the second not
    assert lines[0] in text and lines[1] not in text
    assert ('|A x - b|' in text) == (algorithm != 'fdk') and 'of 8 views' in text and str(out) in text


def test_the_volume_is_the_algorithms(scene, dataset, tmp_path):
    run(RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=2', '--views', '4', '--out', tmp_path / 'v.nii')
    image = nibabel.load(tmp_path / 'v.nii')
    assert np.allclose(image.affine[:3, 3], -11.5)
    np.testing.assert_array_equal(load(tmp_path / 'v.nii'), run_algorithm(dataset.train.subset([0, 2, 4, 6]), SART(2)))


def test_best(scene, dataset, tmp_path):
    out, plan, error = (tmp_path / name for name in ('v.nii.gz', 'v-plan.json', 'v-error.nii.gz'))
    command = (scene, '--algorithm', 'best', '--out', out, '-D', 'niter=2', '-D', 'finer=1')
    code, text, err = run(RECONSTRUCT, *command, '--report', tmp_path / 'v.html')
    assert '"name":"Error map"' in (page := (tmp_path / 'v.html').read_text()) and 'v.nii.gz' in page
    assert code == 0 and 'best of 8 views' in text and '(100%)' in err, err
    result = run_algorithm(dataset.train, Best(niter=2, finer=1))
    np.testing.assert_array_equal(load(out), result.volume)
    np.testing.assert_array_equal(load(error), result.error)
    assert result.report() in text
    assert json.loads(plan.read_text())['tried'] == result.record()['tried']
    out.unlink()  # what is beside it is not replaced either
    code, _, err = run(RECONSTRUCT, *command)
    assert code == 2 and 'v-plan.json: exists already' in err and not out.exists()


@pytest.mark.thorough
def test_best_with_a_cloud(scene, tmp_path):
    command = ('--algorithm', 'best', '--out', tmp_path / 'v.nii', '-D', 'niter=2', '-D', 'finer=1', '-D', 'cloud=true')
    code, text, err = run(RECONSTRUCT, scene, *command)
    assert code == 0 and 'refined, cloud' in text and '(100%)' in err, err


@pytest.mark.parametrize('option', ['--complete', '--start'])
def test_an_unset_variable_of_the_shell(scene, tmp_path, option):
    code, _, err = run(RECONSTRUCT, scene, '--algorithm', 'sart', option, '', '--out', tmp_path / 'v.nii')
    assert code == 2 and f'{option} names no file' in err and not (tmp_path / 'v.nii').exists()


def test_fdk_of_a_turned_panel(dataset, tmp_path):
    """The error is as small as in the scene whose panel is upright."""
    panel = '<string name="dDetector" value="1.8, 1.8"/>'
    path = changed_scene(tmp_path, (panel, panel + '<string name="rotDetector" value="3, -4, 5"/>'))
    code, _, err = run(RECONSTRUCT, path, '--out', tmp_path / 'v.nii')
    assert code == 0, err
    volume, turned = load(tmp_path / 'v.nii'), take_scan(load_scene(path)).train
    assert (
        psnr_3d_r2(volume, dataset.volume)
        > psnr_3d_r2(run_algorithm(dataset.train, FDK()).volume, dataset.volume) - 0.3
    )
    np.testing.assert_array_equal(volume, run_algorithm(turned, FDK()))


def test_two_stage(scene, dataset, fitted, tmp_path):
    code, text, err = run(RECONSTRUCT, scene, '--complete', fitted, '--views', '16', '--out', tmp_path / 'v.nii')
    assert code == 0 and 'of 16 views' in text, err
    cloud = load_fit(fitted)
    measured = fitted_views(dataset.train, cloud.nominal_geometry)
    np.testing.assert_array_equal(measured.projections, dataset.train.projections[::2])
    whole = complete_views(measured, cloud, 16)
    assert_same(load(tmp_path / 'v.nii'), run_algorithm(whole, FDK()).volume)
    np.testing.assert_array_equal(whole.projections[:4], measured.projections)
    loaded = load_scene(fitted)
    image = np.array(mi.render(loaded.scene, sensor=loaded.scanner.view(5, whole.geometry)))[..., 0]
    np.testing.assert_allclose(whole.projections[5], image, atol=1e-5 * image.max())
    assert (
        psnr_3d_r2(run_algorithm(whole, FDK()).volume, dataset.volume)
        > psnr_3d_r2(run_algorithm(measured, FDK()).volume, dataset.volume) + 0.5
    )
    with pytest.raises(InputError, match='ask for more'):
        complete_views(measured, cloud, 3)
    assert complete_views(measured, cloud, 4) is measured


def test_voxelize(scene, dataset, fitted, tmp_path):
    """At once, and in slabs."""
    command = RECONSTRUCT, scene, '--algorithm', 'voxelize', '--complete', fitted, '--out'
    code, text, err = run(*command, tmp_path / 'v.nii')
    assert code == 0, err
    result = load(fitted.with_name('volume.nii.gz'))
    assert np.linalg.norm(load(tmp_path / 'v.nii') - result) < 1e-4 * np.linalg.norm(result)
    assert 'voxelize of a fit to 4 views' in text
    code, text, err = run(*command, tmp_path / 'slabs.nii', '--slab', 9)
    assert code == 0 and 'voxels in slabs of 9 slices' in text, err
    np.testing.assert_allclose(load(tmp_path / 'slabs.nii'), load(tmp_path / 'v.nii'), atol=1e-5 * result.max())


def test_start(scene, dataset, fitted, tmp_path):
    """An iterative algorithm goes on from the cloud's volume, with the views of its fit."""
    code, text, err = run(
        RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=3', '--start', fitted, '--out', tmp_path / 'v.nii'
    )
    assert code == 0 and 'of 4 views' in text, err
    cloud = load_fit(fitted)
    scan = fitted_views(dataset.train, cloud.nominal_geometry)
    cloud_volume = cloud.volume(scan.geometry.grid)
    assert_same_volume(load(tmp_path / 'v.nii'), run_algorithm(scan, SART(3), start=cloud_volume).volume)
    assert psnr_3d_r2(load(tmp_path / 'v.nii'), dataset.volume) > psnr_3d_r2(cloud_volume, dataset.volume) + 0.5


def test_refined(scene, dataset, fitted, tmp_path):
    """From the cloud's volume: passes over all views, then total variation and the measured ones."""
    code, text, err = run(
        RECONSTRUCT,
        scene,
        '--algorithm',
        'refined',
        '-D',
        'niter=4',
        '--complete',
        fitted,
        '--views',
        12,
        '--out',
        tmp_path / 'v.nii',
    )
    assert code == 0 and 'refined of 4 views' in text and '5/5 (100%)' in err, err
    cloud = load_fit(fitted)
    measured = fitted_views(dataset.train, cloud.nominal_geometry)
    cloud_volume = cloud.volume(measured.geometry.grid)
    blur = excess_width(measured.geometry)
    rates = dict(alpha=0.12, alpha_red=0.87, rmax=0.65, maxl2err=0, exact_every=5)
    first = run_algorithm(
        complete_views(measured, cloud, 12), SART(1), start=cloud_volume, weights=structure(cloud_volume), blur=blur
    )
    then = run_algorithm(measured, ASDPOCS(4, **rates), start=first, weights=structure(first.volume), blur=blur)
    assert_same_volume(load(tmp_path / 'v.nii'), then.volume)
    assert psnr_3d_r2(then.volume, dataset.volume) > psnr_3d_r2(cloud_volume, dataset.volume) + 0.5
    # Means of smaller voxels, on which the cloud is sampled anew.
    code, _, err = run(
        RECONSTRUCT,
        scene,
        '--algorithm',
        'refined',
        '-D',
        'niter=2',
        '-D',
        'completed_niter=0',
        '-D',
        'finer=2',
        '--complete',
        fitted,
        '--views',
        12,
        '--out',
        tmp_path / 's.nii',
    )
    assert code == 0 and '2/2 (100%)' in err, err
    g = measured.geometry
    small = replace(
        measured, geometry=g.on(Grid([2 * n for n in g.grid.shape], [d / 2 for d in g.grid.spacing], g.grid.centre))
    )
    cloud_volume = cloud.volume(small.geometry.grid)
    fine = excess_width(small.geometry)
    then = run_algorithm(
        small, ASDPOCS(2, **rates), start=cloud_volume, weights=structure(cloud_volume), blur=fine
    ).volume
    eight = [then[i::2, j::2, k::2] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    np.testing.assert_allclose(load(tmp_path / 's.nii'), np.mean(eight, 0), atol=1e-6 * then.max())
    # Of the measured views alone, which any scan will do for.
    code, text, err = run(
        RECONSTRUCT, scene, '--algorithm', 'refined', '-D', 'niter=2', '--start', fitted, '--out', tmp_path / 'm.nii'
    )
    assert code == 0 and 'refined of 4 views' in text and '2/2 (100%)' in err, err
    cloud_volume = cloud.volume(g.grid)
    then = run_algorithm(measured, ASDPOCS(2, **rates), start=cloud_volume, weights=structure(cloud_volume), blur=blur)
    np.testing.assert_array_equal(load(tmp_path / 'm.nii'), then.volume)
    code, _, err = run(RECONSTRUCT, scene, '--algorithm', 'refined', '-D', 'completed_niter=1', '--start', fitted)
    assert code == 2 and err.count('error') == 1 and 'completed_niter must be 0' in err, err
    for wrong in ('0', '1000'):  # no voxels, and more than an array can hold
        code, _, err = run(
            RECONSTRUCT, scene, '--algorithm', 'refined', '-D', f'finer={wrong}', '--complete', fitted, '--views', 12
        )
        assert code == 2 and err.count('\n') == 1 and ('finer' if wrong == '0' else 'array can hold') in err, err


# ---- effects ---------------------------------------------------------------------------------------------------------


@physics
def test_hardening_is_taken_out_first(tmp_path):
    clean = SCENE.replace('value="24"/>', 'value="24"/> <float name="scale" value="0.1"/>', 1)
    tube = '<emitter type="xray_tube"><float name="kvp" value="120"/><string name="material" value="water"/></emitter>'
    hard, out = tmp_path / 'hard.xml', tmp_path / 'v.nii'
    (tmp_path / 'clean.xml').write_text(clean)
    hard.write_text(clean.replace('</scene>', tube + '</scene>'))
    code, _, err = run(RECONSTRUCT, hard, '--out', out)
    assert code == 0, err
    expected = run_algorithm(take_scan(load_scene(tmp_path / 'clean.xml')).train, FDK()).volume
    size = np.linalg.norm(expected)
    assert np.linalg.norm(load(out) - expected) < 1e-3 * size
    ignored = run_algorithm(replace(take_scan(load_scene(hard)).train, effects=None), FDK()).volume
    assert np.linalg.norm(ignored - expected) > 0.02 * size
    # Three materials cannot be told apart: the advice is to leave them out.
    hard.write_text(
        hard.read_text().replace(
            'value="water"/>',
            'value="water + Al"/><string name="split" value="0.2, 0.3"/><string name="material_foot" value="Fe"/>',
        )
    )
    code, _, err = run(RECONSTRUCT, hard, '--out', out, '--force')
    assert code == 2 and 'leave it out with -D effects=ignore' in err
    code, _, err = run(RECONSTRUCT, hard, '--out', out, '--force', '-D', 'effects=ignore')
    assert code == 0, err
    as_it_is = replace(take_scan(load_scene(hard)).train, effects=None)
    np.testing.assert_array_equal(load(out), run_algorithm(as_it_is, FDK()).volume)


def fitted_cloud(folder, geometry, effects, factor=1.0):
    """The path of a scene of Gaussians of two materials, and what `completion` asks of a fit of them.

    All densities are times `factor`.
    """
    folder.mkdir()
    rng, n = np.random.default_rng(0), 30
    density, turn = rng.uniform(0.02, 0.08, n), rng.normal(size=(n, 4))
    write_ply(
        folder / 'gaussians.ply',
        rng.uniform(-6, 6, (n, 3)),
        rng.uniform(1, 2.5, (n, 3)),
        turn,
        density * factor,
        None if effects is None else (density > 0.05).astype(float),
    )
    write_scene(path := folder / 'result.xml', geometry, 7, effects)
    [cloud] = find_objects(load_scene(path).scene)
    return path, SimpleNamespace(
        model=SimpleNamespace(response=None, effects=effects),
        method=R2(extent=7),
        poses=None,
        cloud=lambda: cloud,
        line_integrals=lambda views: render_objects([cloud], views, 7),
    )


@physics
def test_measured_views_become_what_is_rendered(dataset, tmp_path):
    """Completed with line integrals, two materials seen through a blur must become such, also by a cloud that is off."""
    effects = Effects(tube('soft tissue + bone', '0.03, 0.06'), FocalSpot(), detector(psf=3.0))
    geometry = dataset.train.geometry
    path, true = fitted_cloud(tmp_path / 'true', geometry, effects)
    measured = take_scan(load_scene(path)).train
    expected = render_objects([true.cloud()], geometry)

    def error(projections):
        return np.linalg.norm(projections - expected) / np.linalg.norm(expected)

    assert error(complete_views(measured, true, 12).projections[:8]) < 1e-5
    _, off = fitted_cloud(tmp_path / 'off', geometry, effects, 0.9)
    alone = error(effects.without_hardening(measured.projections))
    assert error(without_effects(measured, off).projections) < 0.3 * alone and alone > 0.02
    _, ignored = fitted_cloud(tmp_path / 'ignored', geometry, None)
    np.testing.assert_array_equal(complete_views(measured, ignored, 12).projections[:8], measured.projections)


def test_missing_angles(dataset):
    geometry = dataset.train.geometry

    def missing_angles(angles, count):
        return views.missing_angles(replace(geometry, angles=angles), count)

    np.testing.assert_allclose(np.sort(np.append(circular(5), missing_angles(circular(5), 20))), circular(20))
    half = missing_angles(circular(5, 180), 20)
    np.testing.assert_allclose(np.sort(np.append(circular(5, 180), half)), circular(20, 180))
    assert len(missing_angles(circular(5), 7)) == 2
    limited = np.radians([-30.0, 0, 30])  # no view is rendered outside of what was measured
    np.testing.assert_allclose(np.degrees(np.sort(missing_angles(limited, 7))), [-20, -10, 10, 20])
    np.testing.assert_allclose(np.sort(missing_angles(np.array([0.0]), 4)), circular(4)[1:])


@pytest.mark.parametrize(
    'args, message',
    [
        (['--views', '99'], 'the scan has 8'),
        (['--views', '-1'], '--views'),
        (['-D', 'nitre=3'], 'nitre'),
        (['--algorithm', 'cgls', '-D', 'niter=three'], "-D niter must be a whole number, not 'three'"),
        (['--algorithm', 'cgls', '-D', 'niter=2.5'], '-D niter must be a whole number'),
        (['--algorithm', 'sart', '-D', 'noneg=2'], 'noneg must be true or false'),
        (['-D', 'effects=some'], "'model' or 'ignore'"),
        (['--algorithm', 'sart', '-D', 'lmbda=5'], 'lmbda'),
        (['--algorithm', 'sart', '-D', 'OrderStrategy=sorted'], 'ordered, random, angularDistance'),
        (['--algorithm', 'sart', '-D', 'seed=-1'], 'seed must be'),
        (['--algorithm', 'asd-pocs', '-D', 'alpha=inf'], 'alpha must'),
        (['-D', 'filter=box'], 'ram-lak'),
        (['--out', 'v.npy'], '.nii'),
        (['--algorithm', 'voxelize'], '--complete'),
        (['--views', '0'], '--views must be at least 1'),
        (['--algorithm', 'voxelize', '--complete', 'no.xml', '--views', '9'], 'leave out --views'),
        (['--out', '/proc/v.nii'], 'cannot write'),
        (['--algorithm', 'refined'], '--complete'),
        (['--algorithm', 'best', '--start', 'x.xml'], 'leave out --complete and --start'),
        (['--start', 'no.xml'], 'iterative'),
        (['--algorithm', 'sart', '-D', 'weights=2'], '-D weights: neither'),
        (['--algorithm', 'sart', '--start', 'no.xml', '--views', '9'], 'iterative'),
        (['--algorithm', 'sart', '--start', 'no.xml'], 'there is no fit here'),
        (['--complete', 'no.xml'], '--views'),
        (['--complete', 'no.xml', '--views', '9'], 'there is no fit here'),
        (['--volume', 'a', '--projections', 'b'], 'exclude'),
        (['--algorithm', 'art'], 'art'),
        (['--seed', '-1'], '--seed'),
        (['--projections', 'no.npy'], 'no.npy'),
    ],
)
def test_bad_input_is_one_line(scene, tmp_path, args, message):
    out = [] if '--out' in args else ['--out', tmp_path / 'new' / 'v.nii.gz']
    code, _, err = run(RECONSTRUCT, scene, *args, *out)
    lines = [line for line in err.splitlines() if line.startswith('error')]
    assert code == 2 and len(lines) == 1 and message in lines[0], err
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(scene, tmp_path):
    out = tmp_path / 'v.nii.gz'
    out.write_text('mine')
    code, _, err = run(RECONSTRUCT, scene, '--out', out)
    assert code == 2 and '--force' in err and out.read_text() == 'mine'
    assert run(RECONSTRUCT, scene, '--out', out, '--force')[0] == 0 and load(out).shape == (24, 24, 24)


def test_a_cloud_of_other_views_or_no_cloud(scene, fitted, tmp_path):
    out = tmp_path / 'v.nii.gz'
    code, _, err = run(RECONSTRUCT, scene, '-D', 'views=3', '--complete', fitted, '--views', '9', '--out', out)
    assert code == 2 and 'the fit saw 4 views' in err
    code, _, err = run(RECONSTRUCT, scene, '--complete', scene, '--views', '9', '--out', out)
    assert code == 2 and 'not a checkpoint' in err and not out.exists()


def refused(*args):
    """The one line by which reconstruct.py refuses its input."""
    code, _, err = run(RECONSTRUCT, *args)
    lines = [line for line in err.splitlines() if not line.startswith(('Scan: ', 'warning: '))]
    assert code == 2 and len(lines) == 1 and lines[0].startswith('error: '), err
    return lines[0]


@pytest.mark.parametrize(
    'entry, says',
    [
        ('"offOrigin" value="0, 0, 1000"', 'no ray meets the volume'),
        ('"offDetector" value="0, 500"', 'no ray meets the volume'),
        ('"DSO" value="10"', 'source lies within the volume'),
        ('"DSD" value="1e5"', None),
    ],
)
def test_scans_that_see_no_volume(tmp_path, entry, says):
    name, line = (entry.split('"')[1], f'<string name={entry}/>' if 'off' in entry else f'<float name={entry}/>')
    old = f'<float name="{name}" value="{dict(DSO=100, DSD=150).get(name)}"/>'
    new = (old, line) if 'off' not in entry else ('<integer name="test_views"', line + '<integer name="test_views"')
    path, out = changed_scene(tmp_path, new), ('--out', tmp_path / 'v.nii')
    if says is None:  # the panel sees a part of it
        code, _, err = run(RECONSTRUCT, path, *out)
        assert code == 0 and 'may be truncated' in err
    else:
        assert says in refused(path, *out)


@pytest.mark.parametrize('factor, says', [(0, 'zero everywhere'), (-1, 'nowhere above zero')])
def test_projections_of_nothing(scene, dataset, tmp_path, factor, says):
    scan = dataset.train
    write_scan(tmp_path / 'scan.npy', replace(scan, projections=factor * scan.projections - 1e-3 * (factor < 0)), 'npy')
    assert says in refused(scene, '--projections', tmp_path / 'scan.npy', '--out', tmp_path / 'v.nii')
    assert not (tmp_path / 'v.nii').exists()


def test_truncated_measurements_are_told(scene, dataset, tmp_path):
    scan = dataset.train
    narrow = replace(scan.geometry, nDetector=(32, 10))
    write_scan(tmp_path / 'scan.npy', Scan(narrow, scan.projections[:, :, 15:25]), 'npy')
    code, _, err = run(RECONSTRUCT, scene, '--projections', tmp_path / 'scan.npy', '--out', tmp_path / 'v.nii')
    assert code == 0 and err.count('may be truncated') == 1, err


def test_too_many_views_and_too_little_memory(scene, fitted, tmp_path, monkeypatch):
    out = '--out', tmp_path / 'v.nii'
    assert 'at most 100000' in refused(scene, '--complete', fitted, '--views', 1_000_000, *out)
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 1e9)
    assert 'GiB of memory' in refused(scene, '--complete', fitted, '--views', 10_000_000, *out)
    size = 4 * (24**3 + 8 * 32 * 40)
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 3.8 * size)
    assert run(RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=1', *out)[0] == 0
    for algorithm in 'cgls', 'asd-pocs':
        assert 'at least' in refused(scene, '--algorithm', algorithm, '-D', 'niter=1', *out, '--force')


# ---- which views a cloud was fitted to ---------------------------------------------------------------------------------

QUICK = '--iterations', '20', '-D', 'n_points=200'


def changed_scene(folder, *pairs):
    """The tiny scene with some of its lines replaced."""
    text = SCENE
    for old, new in pairs:
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / 'scene.xml').write_text(text)
    return folder / 'scene.xml'


def test_a_helix_comes_back_to_its_angles(tmp_path):
    """At another height: the views of two turns are told by their rays, each is taken once and in its place."""
    path = changed_scene(
        tmp_path,
        (
            '"views" value="$views"/>',
            '"views" value="$views"/> <float name="pitch" value="4"/>'
            '<float name="startAngle" value="-360"/> <float name="totalAngle" value="720"/>',
        ),
    )
    code, _, err = fit(path, *QUICK, '--views', '4', '--out', tmp_path / 'fit')
    assert code == 0, err
    dataset, cloud = take_scan(load_scene(path)), load_fit(tmp_path / 'fit' / 'result.xml')
    assert len(np.unique(np.round(np.mod(cloud.nominal_geometry.angles + 1e-6, 2 * np.pi), 4))) == 2
    np.testing.assert_array_equal(
        fitted_views(dataset.train, cloud.nominal_geometry).projections, dataset.train.projections[::2]
    )
    mixed = dataset.train.geometry.subset([5, 1, 6])
    np.testing.assert_array_equal(fitted_views(dataset.train, mixed).projections, dataset.train.projections[[5, 1, 6]])


def test_views_that_repeat_each_other(dataset):
    """Each is taken once; those that fit.py chooses, where these are of the right rays."""
    geometry = dataset.train.geometry
    twice = Scan(geometry.joined(geometry), np.arange(16.0)[:, None, None] * np.ones((1, *geometry.nDetector)))

    def chosen(views):
        return fitted_views(twice, geometry.joined(geometry).subset(views)).projections[:, 0, 0].tolist()

    assert chosen([0, 3, 6, 9, 12]) == [0, 3, 6, 9, 12] and chosen([3, 11, 4]) == [3, 11, 4]
    with pytest.raises(InputError, match='not all of them'):
        chosen([3, 3, 3])


def test_corrected_poses(scene, tmp_path):
    """A fit that corrects poses knows its measured views still; they are used where it has put them."""
    path = tmp_path / 'fit' / 'result.xml'
    code, _, err = fit(scene, *QUICK, '--views', '4', '-D', 'rate_pose=2e-2,2e-3', '--out', path.parent)
    assert code == 0, err
    dataset, cloud = take_scan(load_scene(scene)), load_fit(path)
    geometry = dataset.train.geometry
    assert isinstance(cloud.nominal_geometry, CircularGeometry) and isinstance(cloud.geometry, PosedGeometry)
    np.testing.assert_allclose(cloud.nominal_geometry.rays().source, geometry.rays().source[::2], atol=1e-4)
    measured = fitted_views(dataset.train, cloud.nominal_geometry)
    np.testing.assert_array_equal(measured.projections, dataset.train.projections[::2])
    whole = complete_views(measured, cloud, 8)
    np.testing.assert_allclose(whole.geometry.rays().corner[:4], cloud.geometry.rays().corner)
    np.testing.assert_allclose(whole.geometry.rays().corner[4:], geometry.rays().corner[1::2], atol=1e-9)
    out = '--out', tmp_path / 'v.nii', '--force'
    code, text, err = run(RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=2', '--start', path, *out)
    assert code == 0 and 'of 4 views' in text, err
    cloud_volume = cloud.volume(geometry.grid)
    expected = run_algorithm(
        as_corrected(measured, cloud), SART(2), start=cloud_volume
    ).volume  # up to the order of sums
    np.testing.assert_allclose(load(tmp_path / 'v.nii'), expected, rtol=1e-4, atol=1e-5 * expected.max())
    code, _, err = run(
        RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=1', '--complete', path, '--views', 8, *out
    )
    assert code == 0, err
    code, _, err = run(RECONSTRUCT, scene, '--complete', path, '--views', 8, *out)
    assert code == 2 and 'corrected the poses' in err


def test_the_noise_is_that_of_the_fit(tmp_path):
    film = '<film type="ct_detector"><float name="photons" value="1e3"/></film>'
    panel = '<string name="nDetector" value="32, 40"/>'
    path = changed_scene(
        tmp_path,
        (panel, panel + film),
        ('value="24"/>\n            <tr', 'value="24"/> <float name="scale" value="0.05"/>\n            <tr'),
    )
    code, _, err = fit(path, *QUICK, '--views', '4', '--seed', '3', '--out', tmp_path / 'fit')
    assert code == 0, err
    cloud = load_fit(tmp_path / 'fit' / 'result.xml')
    assert cloud.checkpoint.seed == 3

    def volume(*args):
        code, _, err = run(
            RECONSTRUCT, path, '--algorithm', 'sart', '-D', 'niter=1', '--out', tmp_path / 'v.nii', '--force', *args
        )
        assert code == 0, err
        return load(tmp_path / 'v.nii')

    def expected(seed):
        scan = fitted_views(take_scan(load_scene(path), seed=seed).train, cloud.nominal_geometry)
        cloud_volume = cloud.volume(scan.geometry.grid)
        return run_algorithm(without_effects(scan, cloud), SART(1), start=cloud_volume).volume

    start = '--start', tmp_path / 'fit' / 'result.xml'
    np.testing.assert_allclose(volume(*start), expected(3), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(volume(*start, '--seed', 1), expected(1), rtol=1e-4, atol=1e-5)
    assert np.abs(volume('--seed', 1) - volume()).max() > 0


def test_units_of_the_volume(scene, tmp_path):
    """A fit, an algorithm and its slabs, in Hounsfield units."""
    hu = '--units', 'hu', '--mu-water', '0.02'
    for name, options in {'plain.nii': (), 'hu.nii': hu, 'slabs.nii': (*hu, '--slab', '9')}.items():
        code, _, err = run(RECONSTRUCT, scene, '--out', tmp_path / name, *options)
        assert code == 0, err
    expected = 1000 * (load(tmp_path / 'plain.nii') / 0.02 - 1)
    for name in ('hu.nii', 'slabs.nii'):
        np.testing.assert_allclose(load(tmp_path / name), expected, rtol=1e-4, atol=1e-3 * expected.max())
    short = '--iterations', '2', '-D', 'n_points=50'
    code, _, err = fit(scene, *short, *hu, '--out', tmp_path / 'fit')
    assert code == 0, err
    volume = load_fit(tmp_path / 'fit').volume()
    np.testing.assert_allclose(
        load(tmp_path / 'fit' / 'volume.nii.gz'), 1000 * (volume / 0.02 - 1), rtol=1e-4, atol=0.01
    )
