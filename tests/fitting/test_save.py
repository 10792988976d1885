"""The files that a fit writes from its checkpoint alone."""

import json
from dataclasses import replace

import nibabel
import numpy as np
import pytest

from helpers.fits import SHORT, geometry, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measure import summary
from lingo_mi.scan import Dataset


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    scan, path = tiny_scan(geometry()), tmp_path_factory.mktemp('fit') / 'checkpoint.npz'
    run(scan, SHORT.changed(iterations=3), seed=3, path=path)
    return path


def test_a_result_without_a_scan(checkpoint, tmp_path, no_report):
    fit = Fit.load(checkpoint)
    record = json.loads((fit.save(tmp_path / 'out') / 'metrics.json').read_text())
    assert Fit.load(tmp_path / 'out').record == record
    assert record['psnr_2d'] is None and record['psnr_3d'] is None and record['test_angles'] == []
    assert (record['seed'], record['views'], record['settings']['lambda_tv']) == (3, 3, SHORT.loss.lambda_tv)
    np.testing.assert_allclose(nibabel.load(tmp_path / 'out' / 'volume.nii.gz').get_fdata(), fit.volume(), rtol=1e-6)
    assert (tmp_path / 'out' / 'result.xml').exists() and not (tmp_path / 'out' / 'views').exists()
    assert 'PSNR' not in summary(record) and 'n/a' not in summary(record)


@pytest.mark.parametrize(
    'effects, arrays, message',
    [
        (True, {}, 'has modelled effects of its scan, which a checkpoint does not hold'),
        (False, dict(share=np.zeros(60, np.float32)), 'array.share.*does not belong there'),
        (False, dict(scattered=np.zeros((2, 3, 4, 4))), 'array.scattered.*does not belong there'),
    ],
)
def test_effects_that_a_checkpoint_does_not_hold(checkpoint, tmp_path, effects, arrays, message):
    stored = Checkpoint.load(checkpoint)
    replace(stored, effects=effects, arrays=stored.arrays | arrays).save(tmp_path / 'fit.npz')
    with pytest.raises(InputError, match=message):
        Fit.load(tmp_path / 'fit.npz')


def compared(checkpoint):
    """The fit, to be compared with two views and its volume."""
    fit = Fit.load(checkpoint)
    return fit.with_data(Dataset(tiny_scan(geometry()), tiny_scan(geometry(2)), fit.volume()))


def test_the_held_out_views_of_the_summary_are_absolute(checkpoint):
    numbers = compared(checkpoint).numbers
    assert f'PSNR {numbers["psnr_2d"]:.2f} dB, SSIM {numbers["ssim_2d"]:.4f}' in summary(numbers)
    assert numbers['ssim_2d'] != numbers['ssim_2d_r2']


def test_a_result_with_what_it_is_compared_with(checkpoint, tmp_path, no_report):
    folder = compared(checkpoint).save(tmp_path / 'out', title='itself', note=dict(command='fit'))
    record = json.loads((folder / 'metrics.json').read_text())
    assert record['ssim_3d'] == pytest.approx(1) and record['psnr_2d'] > 0 and len(record['test_angles']) == 2
    assert (record['method'], record['command']) == ('r2', 'fit')
    assert sorted(p.name for p in (folder / 'views').iterdir()) == ['0000.exr', '0001.exr']
