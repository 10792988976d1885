"""scripts/reconstruct.py from end to end on a tiny scene."""

import json
import re
from dataclasses import replace

import nibabel
import numpy as np
import pytest

from helpers.effects import physics
from helpers.script import RECONSTRUCT, SCENE, changed_scene, fit, load, run
from lingo_mi.fitting.fit import load_fit
from lingo_mi.fitting.measure import volume_quality
from lingo_mi.metrics.quality import compared, psnr_3d, psnr_3d_r2
from lingo_mi.reconstruction import FDK, SART, Best
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import take_scan


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


def test_units_of_the_volume(scene, tmp_path):
    """A fit, an algorithm and its slabs write Hounsfield units."""
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
