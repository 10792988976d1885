"""scripts/reconstruct.py with a fit: completed views, starts, and which views the fit has seen."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from helpers.effect_parts import detector, tube
from helpers.effects import physics
from helpers.same import assert_same, assert_same_volume
from helpers.script import RECONSTRUCT, changed_scene, fit, load, run
from lingo_mi.common.errors import InputError
from lingo_mi.completion import views
from lingo_mi.completion.views import as_corrected, complete_views, fitted_views, without_effects
from lingo_mi.effects.focal_spot import FocalSpot
from lingo_mi.effects.forward import Effects
from lingo_mi.files.ply import write_ply
from lingo_mi.fitting.fit import load_fit
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.scene_file import write_scene
from lingo_mi.geometry import CircularGeometry, Grid, PosedGeometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import psnr_3d_r2
from lingo_mi.projectors.objects import find_objects
from lingo_mi.reconstruction import ASDPOCS, FDK, SART
from lingo_mi.reconstruction.refined import structure
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.wide_pixels import excess_width
from lingo_mi.scan import Scan
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import render_objects, take_scan

QUICK = '--iterations', '20', '-D', 'n_points=200'


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
    """A fit's volume is the same at once and in slabs."""
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
    """`refined` starts from the cloud's volume, fits all views, and then the measured ones with total variation."""
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


def fitted_cloud(folder, geometry, effects, factor=1.0):
    """The path of a scene of Gaussians of two materials, and what `completion` asks of a fit of them. `factor` multiplies all
    densities."""
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
    """Views of two materials through a blur become line integrals before completion, even by a cloud that is off."""
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


def test_a_cloud_of_other_views_or_no_cloud(scene, fitted, tmp_path):
    out = tmp_path / 'v.nii.gz'
    code, _, err = run(RECONSTRUCT, scene, '-D', 'views=3', '--complete', fitted, '--views', '9', '--out', out)
    assert code == 2 and 'the fit saw 4 views' in err
    code, _, err = run(RECONSTRUCT, scene, '--complete', scene, '--views', '9', '--out', out)
    assert code == 2 and 'not a checkpoint' in err and not out.exists()


def test_a_helix_comes_back_to_its_angles(tmp_path):
    """Views at equal angles of two turns are told apart by their rays; each is taken once and in its place."""
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
    """Each view is taken once. If the views that fit.py chooses have the right rays, they are taken."""
    geometry = dataset.train.geometry
    twice = Scan(geometry.joined(geometry), np.arange(16.0)[:, None, None] * np.ones((1, *geometry.nDetector)))

    def chosen(views):
        return fitted_views(twice, geometry.joined(geometry).subset(views)).projections[:, 0, 0].tolist()

    assert chosen([0, 3, 6, 9, 12]) == [0, 3, 6, 9, 12] and chosen([3, 11, 4]) == [3, 11, 4]
    with pytest.raises(InputError, match='not all of them'):
        chosen([3, 3, 3])


def test_corrected_poses(scene, tmp_path):
    """A fit that corrects poses still knows its measured views, and they are used at the corrected poses."""
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
