"""A neural field from end to end on a tiny scene: fit, its files, resume, the two-stage way, and bad input in one line."""

import json

import nibabel
import numpy as np
import pytest

import lingo_mi as lm
from helpers.script import FIT, fit, run
from lingo_mi.common.errors import InputError
from lingo_mi.projectors import grid
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import take_scan

RECONSTRUCT = FIT.with_name('reconstruct.py')
CHANGES = dict(
    field_levels=4,
    field_entries=2**12,
    field_base=4,
    field_cube=1.25,
    field_width=16,
    field_samples=32,
    field_rays=128,
    rate_features='1e-2,1e-3',
    rate_network='3e-3,3e-4',
    epsilon=1e-10,
)
OPTIONS = ['--method', 'naf', '--views', '4', *(part for k, v in CHANGES.items() for part in ('-D', f'{k}={v}'))]


@pytest.fixture(scope='module')
def fitted(scene):
    """The folder of a short fit to four of the eight views, and what it has printed."""
    folder = scene.parent / 'naf'
    code, out, err = fit(scene, *OPTIONS, '--iterations', '200', '--out', folder, report=True)
    assert code == 0, err
    return folder, out


def test_files_and_summary(fitted):
    folder, out = fitted
    names = {p.name for p in folder.iterdir()}
    assert {
        'volume.nii.gz',
        'result.xml',
        'checkpoint.npz',
        'metrics.json',
        'report.html',
        'report.png',
        'views',
    } <= names
    assert 'gaussians.ply' not in names and 'gaussians.ply' not in out
    record = json.loads((folder / 'metrics.json').read_text())
    assert record['psnr_3d'] > 18 and record['psnr_2d'] > 20  # an empty volume has 10, the scan's mean everywhere 11
    assert record['gaussians'] == 0 and record['ipsd'] is None and f'{record["parameters"]:,} parameters' in out
    page = (folder / 'report.html').read_text()
    assert 'Gaussians born' not in page and 'IPSD: mean' not in page and 'PSNR 3D' in page


def test_mitsuba_sees_the_field_as_voxels(fitted):
    """result.xml, through the integrator, gives the projections of volume.nii.gz."""
    folder, _ = fitted
    taken_scan = take_scan(load_scene(folder / 'result.xml')).train
    volume = nibabel.load(folder / 'volume.nii.gz').get_fdata().astype(np.float32)
    np.testing.assert_allclose(taken_scan.projections, grid.project_volume(volume, taken_scan.geometry), atol=1e-4)


def test_the_result_is_read_again(fitted):
    folder, _ = fitted
    result = lm.load_fit(folder / 'result.xml')
    np.testing.assert_allclose(
        result.volume(), nibabel.load(folder / 'volume.nii.gz').get_fdata(), rtol=1e-6, atol=1e-9
    )
    assert 'a field of' in repr(result) and result.metrics()['psnr_3d'] > 18
    with pytest.raises(InputError, match='no Gaussians'):
        result.gaussians  # noqa: B018 - the access is what is refused


def test_a_finished_fit_goes_on_to_the_same_result(fitted, scene):
    folder, _ = fitted
    before = lm.load_fit(folder).volume()
    code, _, err = fit(scene, *OPTIONS, '--iterations', '200', '--out', folder, '--resume')
    assert code == 0, err
    np.testing.assert_array_equal(lm.load_fit(folder).volume(), before)


@pytest.mark.parametrize('algorithm', ['sart', 'refined', 'voxelize'])
def test_completed_views_and_the_fields_volume(fitted, scene, tmp_path, algorithm):
    checkpoint, out = fitted[0] / 'checkpoint.npz', tmp_path / 'volume.nii.gz'
    views = [] if algorithm == 'voxelize' else ['--views', '8']
    code, text, err = run(RECONSTRUCT, scene, '--algorithm', algorithm, '--complete', checkpoint, *views, '--out', out)
    assert code == 0, err
    volume = nibabel.load(out).get_fdata()
    if algorithm == 'voxelize':
        np.testing.assert_allclose(volume, lm.load_fit(fitted[0]).volume(), rtol=1e-6, atol=1e-9)
    assert float(text.split('PSNR ')[1].split()[0]) > 18


def test_a_reconstruction_starts_from_the_field(fitted, scene, tmp_path):
    checkpoint, out = fitted[0] / 'checkpoint.npz', tmp_path / 'volume.nii.gz'
    code, text, err = run(
        RECONSTRUCT, scene, '--algorithm', 'sart', '--start', checkpoint, '-D', 'niter=2', '--out', out
    )
    assert code == 0, err
    assert float(text.split('PSNR ')[1].split()[0]) > 18


def test_what_a_field_cannot_do_is_one_line(fitted, scene, tmp_path):
    for changes, message in (
        (['-D', 'lambda_tv=0.1'], 'lambda_tv: neither'),
        (['-D', 'rate_pose=1e-3,1e-4'], 'rate_pose'),
        (['--start', 'masks'], "'start'"),
        (['-D', 'field_samples=0'], 'field_samples'),
    ):
        code, _, err = fit(scene, '--method', 'naf', *changes, '--out', tmp_path / 'out')
        assert code == 2 and message in err and err.count('\n') == 1, err
        assert not (tmp_path / 'out').exists()
    code, _, err = fit(scene, '--start', 'network', '--out', tmp_path / 'out')
    assert code == 2 and "'masks'" in err and "not 'network'" in err
