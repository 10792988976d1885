"""The quality measures against scikit-image, by hand, and at their edges."""

import time

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from lingo_mi.common.errors import InputError
from lingo_mi.metrics import quality as metrics
from lingo_mi.metrics.quality import (
    psnr_2d,
    psnr_2d_r2,
    psnr_3d,
    psnr_3d_r2,
    ssim_2d,
    ssim_2d_r2,
    ssim_3d,
    ssim_3d_r2,
    ssim_map,
)

BEST = {
    psnr_2d_r2: np.inf,
    psnr_2d: np.inf,
    psnr_3d_r2: np.inf,
    psnr_3d: np.inf,
    ssim_2d_r2: 1.0,
    ssim_2d: 1.0,
    ssim_3d_r2: 1.0,
    ssim_3d: 1.0,
}
ALL = list(BEST)


@pytest.fixture
def pair():
    rng = np.random.default_rng(3)
    truth = rng.random((4, 21, 26)) * np.array([0.5, 1, 2, 3])[:, None, None]
    return truth + rng.normal(0, 0.1, truth.shape), truth


def reference_ssim(a, b):
    # int(3.5 * 1.5 + 0.5) = 5: the 11-wide window.
    return structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, truncate=3.5, data_range=1.0, use_sample_covariance=False, full=True
    )[1]


def test_ssim_map_is_scikit_images_inside_and_zero_padded_outside(pair):
    a, b = pair[0][1], pair[1][1]
    ours = ssim_map(a, b)
    np.testing.assert_allclose(ours[5:-5, 5:-5], reference_ssim(a, b)[5:-5, 5:-5], rtol=1e-12)
    padded = reference_ssim(np.pad(a, 10), np.pad(b, 10))[10:-10, 10:-10]
    np.testing.assert_allclose(ours, padded, rtol=1e-12)


def test_ssim_map_against_the_written_out_sum(pair):
    a, b = np.pad(pair[0][1], 5), np.pad(pair[1][1], 5)
    w = np.exp(-((np.arange(11) - 5.0) ** 2) / 4.5)
    w = np.outer(w, w) / w.sum() ** 2
    for i, j in ((0, 0), (3, 20), (20, 25), (10, 11)):
        p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
        mp, mq = (w * p).sum(), (w * q).sum()
        vp, vq, c = (w * p * p).sum() - mp**2, (w * q * q).sum() - mq**2, (w * p * q).sum() - mp * mq
        expected = (2 * mp * mq + 1e-4) * (2 * c + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
        assert ssim_map(pair[0][1], pair[1][1])[i, j] == pytest.approx(expected, rel=1e-10)


def test_2d_measures_against_scikit_image(pair):
    a, b = pair
    scaled = [(x / x.max(), y / y.max()) for x, y in zip(a, b)]
    assert psnr_2d_r2(a, b) == pytest.approx(
        np.mean([peak_signal_noise_ratio(y, x, data_range=1.0) for x, y in scaled])
    )
    assert psnr_2d(a, b) == pytest.approx(
        np.mean([peak_signal_noise_ratio(y, x, data_range=b.max()) for x, y in zip(a, b)])
    )
    assert psnr_2d(a, b, peak=7.0) == pytest.approx(
        np.mean([peak_signal_noise_ratio(y, x, data_range=7.0) for x, y in zip(a, b)])
    )
    assert ssim_2d_r2(a, b) == pytest.approx(np.mean([ssim_map(x, y) for x, y in scaled]))
    assert ssim_2d(a, b) == pytest.approx(np.mean([ssim_map(x / b.max(), y / b.max()) for x, y in zip(a, b)]))


def test_a_wrong_gain_shows_only_in_the_absolute_measures(pair):
    truth = pair[1]
    assert psnr_2d_r2(truth * 1.25, truth) > 250 and ssim_2d_r2(truth * 1.25, truth) == pytest.approx(1)
    expected = np.mean([10 * np.log10(truth.max() ** 2 / np.mean((0.25 * t) ** 2)) for t in truth])
    assert psnr_2d(truth * 1.25, truth) == pytest.approx(expected)
    assert ssim_2d(truth * 1.25, truth) < 0.99


def test_absolute_measures_do_not_depend_on_the_unit(pair):
    a, b = pair
    assert psnr_2d(a * 40, b * 40) == pytest.approx(psnr_2d(a, b))
    assert ssim_2d(a * 40, b * 40) == pytest.approx(ssim_2d(a, b))


def test_3d_measures(pair):
    rng = np.random.default_rng(4)
    truth = rng.random((13, 17, 15))
    volume = truth + rng.normal(0, 0.05, truth.shape)
    truth[4] = 0  # an empty slice does not count
    assert psnr_3d_r2(volume, truth) == pytest.approx(peak_signal_noise_ratio(truth, volume, data_range=1.0))
    x = np.mean([ssim_map(volume[i], truth[i]).mean() for i in range(13) if i != 4])
    y = np.mean([ssim_map(volume[:, i], truth[:, i]).mean() for i in range(17)])
    z = np.mean([ssim_map(volume[:, :, i], truth[:, :, i]).mean() for i in range(15)])
    assert ssim_3d_r2(volume, truth) == pytest.approx((x + y + z) / 3)
    # The peak stays 1.
    assert psnr_3d_r2(2 * volume, 2 * truth) == pytest.approx(psnr_3d_r2(volume, truth) - 20 * np.log10(2))


def test_absolute_3d_measures_against_scikit_image():
    rng = np.random.default_rng(4)
    truth = 0.02 * rng.random((13, 17, 15))
    volume = truth + rng.normal(0, 0.001, truth.shape)
    assert psnr_3d(volume, truth) == pytest.approx(peak_signal_noise_ratio(truth, volume, data_range=truth.max()))
    assert psnr_3d(volume, truth, 0.1) == pytest.approx(peak_signal_noise_ratio(truth, volume, data_range=0.1))
    for peak in (None, 0.1):
        # Scikit-image continues by mirroring; what it finds inside a border of zeros is continued by zeros.
        scale = peak or truth.max()
        padded = reference_ssim(*(np.pad(x / scale, 10) for x in (volume, truth)))[10:-10, 10:-10, 10:-10]
        assert ssim_3d(volume, truth, peak) == pytest.approx(padded.mean(), rel=1e-10)
    for measure in psnr_3d, ssim_3d:
        assert measure(50 * volume, 50 * truth) == pytest.approx(measure(volume, truth))
        assert measure(1.25 * volume, truth) < measure(volume, truth)


def test_a_fan_beam_slice_is_measured_in_its_plane(pair):
    a, b = pair[0][1], pair[1][1]
    assert ssim_3d_r2(a[:, :, None], b[:, :, None]) == pytest.approx(ssim_map(a, b).mean())
    assert ssim_3d(a[:, :, None], b[:, :, None], 1.0) == pytest.approx(ssim_map(a, b).mean())


@pytest.mark.parametrize('measure', ALL)
def test_identical_and_constant(measure, pair):
    assert measure(pair[1], pair[1]) == pytest.approx(BEST[measure])
    assert measure(np.full((3, 12, 14), 0.7), np.full((3, 12, 14), 0.7)) == pytest.approx(BEST[measure])
    different = measure(np.zeros((3, 12, 14)), np.ones((3, 12, 14)))
    assert np.isfinite(different) and different < 0.01


def test_constant_images_by_hand():
    a, b = np.full((1, 32, 32), 0.5), np.full((1, 32, 32), 1.0)
    assert psnr_2d(a, b) == pytest.approx(20 * np.log10(2))
    assert psnr_2d_r2(a, b) == np.inf
    assert ssim_map(a[0], b[0])[16, 16] == pytest.approx((2 * 0.5 + 1e-4) / (1.25 + 1e-4))


@pytest.mark.parametrize('measure', ALL)
def test_empty_truth(measure):
    zero = np.zeros((3, 12, 12))
    expected = np.inf if measure is psnr_3d_r2 else np.nan
    assert measure(zero, zero) == pytest.approx(expected, nan_ok=True)


def test_r2_form_leaves_empty_views_out(pair):
    a, b = pair
    blank = np.zeros((1, *a.shape[1:]))
    longer = np.concatenate([a, blank + 0.3]), np.concatenate([b, blank])
    assert psnr_2d_r2(*longer) == pytest.approx(psnr_2d_r2(a, b))


@pytest.mark.parametrize('measure', ALL)
def test_bad_input(measure, pair):
    a, b = pair
    broken = a.copy()
    broken[2, 3, 4] = np.nan
    with pytest.raises(InputError, match=r'of the result .*\[2, 3, 4\]'):
        measure(broken, b)
    with pytest.raises(InputError, match='of the truth'):
        measure(b, broken)
    with pytest.raises(InputError, match='shapes'):
        measure(a[:2], b)
    with pytest.raises(InputError, match='shapes'):
        measure(a[0], b[0])


@pytest.mark.parametrize('measure', [psnr_2d, ssim_2d, psnr_3d, ssim_3d])
def test_bad_peak(measure, pair):
    for peak in (0, -1, np.nan):
        with pytest.raises(InputError, match='peak'):
            measure(*pair, peak=peak)


def test_float32_input_is_accumulated_in_float64():
    truth = np.full((64, 64, 64), 0.5, np.float32)
    volume = truth + np.float32(1e-4)
    error = float(volume[0, 0, 0]) - 0.5
    assert psnr_3d_r2(volume, truth) == pytest.approx(-20 * np.log10(error), rel=1e-9)
    assert metrics.WINDOW.sum() == pytest.approx(1)


def test_views_on_threads_keep_their_order_and_few_are_taken_in_advance():
    taken, most = [], 0

    def items():
        for i in range(20):
            taken.append(i)
            yield i, 100

    def slow_first(i, j):
        time.sleep(0.02 * (i == 0))
        return i + j

    for done, actual in enumerate(metrics._each(slow_first, items(), metrics.SLAB)):
        assert actual == done + 100
        most = max(most, len(taken) - done)
    assert most <= 4 and len(taken) == 20  # three slabs at a time
    with pytest.raises(ZeroDivisionError):
        list(metrics._each(lambda i: 1 // i, ((0,),), 1))


@pytest.mark.parametrize('name', ['psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d'])
def test_the_plain_name_is_the_absolute_form(pair, name):
    """This holds in a unit whose full scale is not 1, and with a wrong gain."""
    images, truth = (4 * x for x in pair)
    plain, r2 = (getattr(metrics, n)(1.2 * truth, truth) for n in (name, f'{name}_r2'))
    assert plain == pytest.approx(getattr(metrics, name)(1.2 * truth / 4, truth / 4)) and plain != pytest.approx(r2)
