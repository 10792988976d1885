"""Views of a measured scan that are held out, and what a fit leaves of them."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.fits import SHORT, geometry, tiny_scan
from lingo_mi.api.fitting import fit
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.hold_out import with_held_out
from lingo_mi.fitting.measure import summary
from lingo_mi.fitting.residual import residual_numbers
from lingo_mi.scan import Dataset, Scan


def blank(views, **changes):
    g = geometry(views, nDetector=(8, 24), **changes)
    return Scan(g, np.zeros((views, 8, 24), np.float32))


@pytest.mark.parametrize('views, every, held', [(60, None, 6), (20, None, 2), (19, None, 0), (60, 0, 0), (60, 4, 15)])
def test_evenly_spaced_views_are_held_out(views, every, held):
    scan = blank(views)
    split = with_held_out(Dataset(scan), every)
    assert len(split.train) == views - held and (0 if split.test is None else len(split.test)) == held
    if held:
        steps = np.diff(split.test.geometry.angles) / np.diff(scan.geometry.angles)[0]
        np.testing.assert_allclose(steps, every or 10, rtol=1e-5)
        angles = np.sort(np.concatenate([split.train.geometry.angles, split.test.geometry.angles]))
        np.testing.assert_allclose(angles, scan.geometry.angles, rtol=1e-6)
        assert not np.isin(scan.geometry.angles[[0, -1]], split.test.geometry.angles).any()


def test_nothing_is_held_out_of_what_has_a_truth_or_was_chosen_by_hand():
    scan = blank(60)
    for data in (scan, Dataset(scan, scan), Dataset(scan, None, np.zeros((4, 4, 4)))):
        assert len(with_held_out(data, None).train) == 60
    assert len(with_held_out(scan, 10).test) == 6


def test_a_view_without_a_valid_pixel_measures_nothing():
    valid = np.ones((60, 8, 24), bool)
    valid[5] = False
    split = with_held_out(Dataset(replace(blank(60), valid=valid)), 10)
    assert (len(split.train), len(split.test)) == (55, 5) and split.test.valid is None


@pytest.mark.parametrize(
    'every, message', [(1, 'leaves no view'), (-1, 'hold_out'), (10, 'already'), (2.5, 'hold_out')]
)
def test_what_cannot_be_held_out(every, message):
    with pytest.raises(InputError, match=message):
        with_held_out(Dataset(blank(60), blank(2)), every)
    with pytest.raises(InputError, match='needs 4 views or more'):
        with_held_out(blank(3), 2)


def test_the_residual_of_a_right_answer_is_noise_alone():
    truth = np.tile(2 * np.sin(np.linspace(0, np.pi, 400)) ** 2, (6, 40, 1)).astype(np.float32)
    rng = np.random.default_rng(0)
    counts = rng.poisson(2e4 * np.exp(-truth))
    g = geometry(6, nDetector=(40, 400))
    scan = Scan(g, -np.log(counts / 2e4))
    actual = residual_numbers(truth, scan)
    # The estimate of the noise is a median over 95 000 differences.
    assert actual['residual_to_noise'] == pytest.approx(1, abs=0.02)
    assert actual['residual_rms'] == pytest.approx(np.sqrt(np.exp(truth).mean() / 2e4), rel=0.02)
    wrong = truth.copy()
    wrong[2] += 0.1
    by_view = residual_numbers(wrong, scan)['residual_by_view']
    assert np.argmax(by_view) == 2 and by_view[2] == pytest.approx(np.hypot(0.1, by_view[0]), rel=0.02)
    assert 'residual_to_noise' not in residual_numbers(truth, replace(scan, projections=truth))  # no noise, no ratio


def test_only_valid_pixels_count():
    scan = blank(4)
    valid = np.ones(scan.projections.shape, bool)
    valid[:, :, :12], valid[3] = False, False
    rendered = np.where(valid, 0.5, 9).astype(np.float32)
    actual = residual_numbers(rendered, replace(scan, valid=valid))
    assert actual['residual_rms'] == pytest.approx(0.5)
    assert actual['residual_by_view'] == [pytest.approx(0.5)] * 3 + [None]


def test_a_fit_of_a_measured_scan_says_how_well_it_predicts(tmp_path):
    scan = tiny_scan(geometry(20))
    fitted = fit(Dataset(scan), SHORT.changed(iterations=5), folder=tmp_path / 'out', progress=False)
    numbers = fitted.record
    assert numbers['views'] == 18 and len(numbers['residual_by_view']) == 2 == len(numbers['test_angles'])
    assert 'held-out views  PSNR' in summary(numbers) and 'residual' in summary(numbers)
    page = (tmp_path / 'out' / 'report.html').read_text()
    markup = page[: page.index('<script type="application/json"')]
    assert 'n/a' not in markup and '2 of 20, evenly spaced' in markup and '<h2>Scanner</h2>' in markup
    assert '"Measured"' in page and 'PSNR 3D' not in markup
