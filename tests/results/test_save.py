"""What a fit writes when nothing is known but its checkpoint."""

import json

import nibabel
import numpy as np
import pytest

from helpers.fits import SHORT, geometry, some_points, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.checkpoint import load
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.loop import run
from lingo_mi.results.measure import measure, summary
from lingo_mi.results.save import save


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    scan, path = tiny_scan(geometry()), tmp_path_factory.mktemp('fit') / 'checkpoint.npz'
    run(scan, SHORT.changed(iterations=3), some_points(scan.geometry), seed=3, path=path)
    return path


def test_a_result_without_a_scan(checkpoint, tmp_path):
    fitted = Fitted.from_checkpoint(checkpoint)
    found = save(tmp_path, fitted, measure(fitted))
    assert json.loads(json.dumps(found)) == json.loads((tmp_path / 'metrics.json').read_text())
    assert found['psnr_2d'] is None and found['psnr_3d'] is None and found['test_angles'] == []
    assert (found['seed'], found['views'], found['settings']['lambda_tv']) == (3, 3, SHORT.loss.lambda_tv)
    np.testing.assert_allclose(nibabel.load(tmp_path / 'volume.nii.gz').get_fdata(), fitted.volume(), rtol=1e-6)
    assert (tmp_path / 'result.xml').exists() and not (tmp_path / 'views').exists() and 'n/a' in summary(found)


@pytest.mark.parametrize('array', ['share', 'scattered'])
def test_effects_that_a_checkpoint_does_not_keep(checkpoint, monkeypatch, array):
    """Old ones do not say whether there were any; their arrays do."""
    state, extra, arrays = load(checkpoint)
    del extra['effects']
    monkeypatch.setattr('lingo_mi.fitting.fitted.checkpoint.load', lambda path: (state, extra, arrays | {array: 1}))
    with pytest.raises(InputError, match='has modelled effects of its scan, which a checkpoint does not keep'):
        Fitted.from_checkpoint(checkpoint)


def test_the_held_out_views_of_the_summary_are_absolute(checkpoint):
    fitted, test = Fitted.from_checkpoint(checkpoint), tiny_scan(geometry(2))
    numbers = measure(fitted, test, fitted.volume()).numbers
    assert f'PSNR {numbers["psnr_2d"]:.2f} dB, SSIM {numbers["ssim_2d"]:.4f}' in summary(numbers)
    assert numbers['ssim_2d'] != numbers['ssim_2d_r2']


def test_a_result_with_what_it_is_compared_with(checkpoint, tmp_path):
    fitted, test = Fitted.from_checkpoint(checkpoint), tiny_scan(geometry(2))
    found = save(tmp_path, fitted, measure(fitted, test, fitted.volume()), title='itself', method='r2', command='fit')
    assert found['ssim_3d'] == pytest.approx(1) and found['psnr_2d'] > 0 and len(found['test_angles']) == 2
    assert (found['method'], found['command']) == ('r2', 'fit')
    assert sorted(p.name for p in (tmp_path / 'views').iterdir()) == ['0000.exr', '0001.exr']
