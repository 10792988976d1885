"""scripts/reconstruct.py from end to end on a tiny scene, the two-stage way, and bad input in one line."""
import re

import nibabel
import numpy as np
import pytest
from script import FIT, fit, run

from lingo_mi.errors import InputError
from lingo_mi.geometry import circular
from lingo_mi.metrics import psnr_3d
from lingo_mi.recon.fdk import fdk
from lingo_mi.recon.sart import sart
from lingo_mi.recon.two_stage import complete, fitted_views, load_cloud, missing_angles
from lingo_mi.scanning import load_scene, take_scan

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


@pytest.mark.parametrize('algorithm, options', [
    ('fdk', ['filter=hann']), ('sart', ['niter=2']), ('os-sart', ['niter=2', 'blocksize=3']), ('sirt', ['niter=2']),
    ('cgls', ['niter=3', 'tol=0.01']), ('asd-pocs', ['niter=2', 'tviter=3', 'nonneg=true', 'maxl2err=5'])])
def test_every_algorithm(scene, dataset, tmp_path, algorithm, options):
    out = tmp_path / 'new' / 'volume.nii.gz'
    defined = (a for o in options for a in ('-D', o))
    code, text, err = run(RECONSTRUCT, scene, '--algorithm', algorithm, '--out', out, *defined)
    assert code == 0, err
    shown = float(re.search(r'PSNR (\S+) dB', text)[1])
    assert abs(shown - psnr_3d(load(out), dataset.volume)) < 0.006 and shown > 10
    assert ('|A x - b|' in text) == (algorithm != 'fdk') and 'of 8 views' in text and str(out) in text


def test_the_volume_is_the_functions(scene, dataset, tmp_path):
    run(RECONSTRUCT, scene, '--algorithm', 'sart', '-D', 'niter=2', '--views', '4', '--out', tmp_path / 'v.nii')
    image = nibabel.load(tmp_path / 'v.nii')
    assert np.allclose(image.affine[:3, 3], -11.5)
    np.testing.assert_array_equal(load(tmp_path / 'v.nii'), sart(dataset.train.subset([0, 2, 4, 6]), 2).volume)


def test_two_stage(scene, dataset, fitted, tmp_path):
    code, text, err = run(RECONSTRUCT, scene, '--complete', fitted, '--views', '16', '--out', tmp_path / 'v.nii')
    assert code == 0 and 'of 16 views' in text, err
    cloud, geometry = load_cloud(fitted)
    measured = fitted_views(dataset, geometry)
    np.testing.assert_array_equal(measured.projections, dataset.train.projections[::2])
    whole = complete(measured, cloud, 16)
    np.testing.assert_array_equal(load(tmp_path / 'v.nii'), fdk(whole))
    np.testing.assert_array_equal(whole.projections[:4], measured.projections)
    assert psnr_3d(fdk(whole), dataset.volume) > psnr_3d(fdk(measured), dataset.volume) + 0.5
    with pytest.raises(InputError, match='ask for more'):
        complete(measured, cloud, 3)
    assert complete(measured, cloud, 4) is measured


def test_voxelize(scene, dataset, fitted, tmp_path):
    code, text, err = run(RECONSTRUCT, scene, '--algorithm', 'voxelize', '--complete', fitted, '--out', tmp_path / 'v.nii')
    assert code == 0, err
    result = load(fitted.with_name('volume.nii.gz'))
    assert np.linalg.norm(load(tmp_path / 'v.nii') - result) < 0.02 * np.linalg.norm(result)


def test_missing_angles(dataset):
    geometry = dataset.train.geometry
    np.testing.assert_allclose(np.sort(np.append(circular(5), missing_angles(circular(5), 20, geometry))), circular(20))
    half = missing_angles(circular(5, 180), 20, geometry)
    np.testing.assert_allclose(np.sort(np.append(circular(5, 180), half)), circular(20, 180))
    assert len(missing_angles(circular(5), 7, geometry)) == 2
    np.testing.assert_allclose(np.sort(missing_angles(np.array([0.]), 4, geometry)), circular(4)[1:])


@pytest.mark.parametrize('args, message', [
    (['--views', '99'], 'the scan has 8'), (['--views', '-1'], '--views'), (['-D', 'nitre=3'], 'nitre'),
    (['--algorithm', 'cgls', '-D', 'niter=three'], 'niter=three'),
    (['--algorithm', 'sart', '-D', 'nonneg=2'], 'true or false'),
    (['--algorithm', 'sart', '-D', 'lmbda=5'], 'lmbda'), (['-D', 'filter=box'], 'ram-lak'), (['--out', 'v.npy'], '.nii'),
    (['--algorithm', 'voxelize'], '--complete'), (['--complete', 'no.xml'], '--views'),
    (['--complete', 'no.xml', '--views', '9'], 'no such scene'), (['--volume', 'a', '--projections', 'b'], 'exclude'),
    (['--algorithm', 'art'], 'art'), (['--projections', 'no.npy'], 'no.npy')])
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
    assert code == 2 and 'fitted to 4 views' in err
    code, _, err = run(RECONSTRUCT, scene, '--complete', scene, '--views', '9', '--out', out)
    assert code == 2 and 'no cloud' in err and not out.exists()
