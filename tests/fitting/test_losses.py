"""Losses against float64 references, at their edges, and without compiling anew."""

import numpy as np
import pytest
from scipy.ndimage import correlate1d
from skimage.metrics import structural_similarity

from lingo_mi.common.runtime import use_variant

use_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from lingo_mi.common.errors import InputError  # noqa: E402
from lingo_mi.fitting.losses import combined, gradient_error, tv  # noqa: E402
from lingo_mi.lingo.loss_scale import loss_scale  # noqa: E402
from lingo_mi.metrics.quality import C1, C2, WINDOW, ssim_map  # noqa: E402


def l1(image, truth, *shape):
    return combined(image, truth, *shape, lambda_ssim=0.0, lambda_l1=1.0)


def ssim(image, truth, *shape):
    return 1 - combined(image, truth, *shape, lambda_ssim=1.0, lambda_l1=0.0)


SIZES = [(64, 48), (37, 53), (8, 8), (5, 7), (1, 40), (41, 1), (1, 1)]


def blur(x):
    return correlate1d(correlate1d(x, WINDOW, 0, mode='constant'), WINDOW, 1, mode='constant')


def reference(a, b):
    """Mean SSIM and its gradient, float64, from raw moments."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    ma, mb = blur(a), blur(b)
    variance, covariance = blur(a * a + b * b) - ma * ma - mb * mb, blur(a * b) - ma * mb
    luminance = (2 * ma * mb + C1) / (ma * ma + mb * mb + C1)
    structure = (2 * covariance + C2) / (variance + C2)
    g = 2 * luminance / (variance + C2)
    h = g * structure
    slope = structure * 2 * (mb - ma * luminance) / (ma * ma + mb * mb + C1)
    gradient = blur(slope - g * mb + h * ma) + b * blur(g) - a * blur(h)
    return (luminance * structure).mean(), gradient / a.size


def value_and_gradient(loss, x, *arguments):
    x = mi.Float(np.ravel(x).astype(np.float32))
    dr.enable_grad(x)
    value = loss(x, *arguments)
    dr.backward(value)
    return float(value.numpy()[0]), dr.grad(x).numpy()


def ours(a, b):
    value, gradient = value_and_gradient(ssim, a, mi.Float(b.ravel()), *a.shape)
    return value, gradient.reshape(a.shape)


def images(height, width):
    """Pairs of line integrals between 0 and 10, float32: noise, texture, flat levels, an edge."""
    rng = np.random.default_rng(7)
    noise, other = (10 * rng.random((height, width)) for _ in range(2))
    flat, zero = np.full((height, width), 10.0), np.zeros((height, width))
    edge = np.where(np.add.outer(np.arange(height), 2 * np.arange(width)) > height // 2, 9.7, 0.2)
    grain = rng.normal(0, 0.02, (height, width))
    pairs = dict(
        noise=(noise, other),
        similar=(noise + grain, noise),
        flat=(flat, flat / 2),
        zero=(zero, noise),
        empty=(noise, zero),
        grain=(flat + grain, flat),
        edge=(edge + grain, edge),
    )
    return {name: (a.astype(np.float32), b.astype(np.float32)) for name, (a, b) in pairs.items()}


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('name', list(images(1, 1)))
def test_ssim_and_its_gradient_match_float64(size, name):
    a, b = images(*size)[name]
    value, gradient = ours(a, b)
    expected, slope = reference(a, b)
    assert value == pytest.approx(expected, abs=1e-6)
    assert value == pytest.approx(ssim_map(a.astype(float), b.astype(float)).mean(), abs=1e-6)
    # For slopes near zero, errors are far below the slope of L1, 1 / a.size.
    assert np.abs(gradient - slope).max() <= 1e-4 * np.abs(slope).max() + 2e-7 / a.size


def test_the_reference_gradient_is_the_derivative():
    a, b = (x.astype(np.float64) for x in images(9, 14)['noise'])
    _, gradient = reference(a, b)
    for at in [(0, 0), (4, 7), (8, 13)]:
        step = np.zeros_like(a)
        step[at] = 1e-5
        difference = ssim_map(a + step, b).mean() - ssim_map(a - step, b).mean()
        assert gradient[at] == pytest.approx(difference / 2e-5, rel=1e-5)


def test_ssim_is_scikit_images_away_from_the_border():
    a, b = images(64, 48)['similar']
    a[:8], a[-8:], a[:, :8], a[:, -8:] = 0, 0, 0, 0
    b[:8], b[-8:], b[:, :8], b[:, -8:] = 0, 0, 0, 0
    full = structural_similarity(
        a.astype(float),
        b.astype(float),
        gaussian_weights=True,
        sigma=1.5,
        truncate=3.5,
        data_range=1.0,
        use_sample_covariance=False,
        full=True,
    )[1]
    assert ours(a, b)[0] == pytest.approx(full.mean(), abs=1e-6)


@pytest.mark.parametrize('level', [0, 1e-6, 3, 10, 1e6])
def test_a_constant_image_is_like_itself(level):
    a = np.full((21, 34), level, np.float32)
    value, gradient = ours(a, a)
    assert value == pytest.approx(1, abs=1e-6)
    assert np.abs(gradient).max() < 1e-9


def test_the_combined_loss_is_the_sum_of_its_parts():
    a, b = images(37, 53)['similar']
    a[3, 5:9] = b[3, 5:9]
    truth = mi.Float(b.ravel())
    value, gradient = value_and_gradient(lambda x: 3 * combined(x, truth, *a.shape, 0.25), a)
    value_l1, gradient_l1 = value_and_gradient(lambda x: l1(x, truth, *a.shape), a)
    value_ssim, gradient_ssim = ours(a, b)
    assert value_l1 == pytest.approx(np.abs(a.astype(float) - b).mean(), rel=1e-5)
    np.testing.assert_allclose(gradient_l1, np.sign(a - b).ravel() / a.size, rtol=1e-6)
    assert value == pytest.approx(3 * (value_l1 + 0.25 * (1 - value_ssim)), rel=1e-5)
    np.testing.assert_allclose(gradient, 3 * (gradient_l1 - 0.25 * gradient_ssim.ravel()), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('name', ['noise', 'similar', 'edge'])
def test_the_error_of_the_gradient_matches_float64(size, name):
    a, b = images(*size)[name]
    difference = a.astype(float) - b
    down, across = np.diff(difference, axis=0), np.diff(difference, axis=1)
    expected = np.sqrt(((down**2).sum() + (across**2).sum()) / a.size)
    # Of the sum of squared steps s: each pixel ends one step and begins another.
    slope = -np.diff(np.pad(down, ((1, 1), (0, 0))), axis=0) - np.diff(np.pad(across, ((0, 0), (1, 1))), axis=1)
    value, gradient = value_and_gradient(lambda x: 3 * gradient_error(x, mi.Float(b.ravel()), *size), a)
    assert value == pytest.approx(3 * expected, rel=1e-5, abs=1e-12)
    wanted = 3 * slope.ravel() / (a.size * expected) if expected > 0 else np.zeros(a.size)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-4, atol=1e-5 * np.abs(wanted).max())


def test_the_error_of_the_gradient_does_not_see_a_constant():
    a = images(21, 34)['noise'][0]
    value, gradient = value_and_gradient(gradient_error, a, mi.Float(a.ravel()), 21, 34)
    assert value == 0 and not gradient.any()
    shifted = mi.Float((np.round(a) + 4).ravel())  # whole numbers: the difference is the same in float32
    value, gradient = value_and_gradient(gradient_error, np.round(a), shifted, 21, 34)
    assert value == 0 and not gradient.any()


def test_the_weights_of_a_loss():
    a, b = images(37, 53)['similar']
    truth = mi.Float(b.ravel())
    parts = [
        lambda x: l1(x, truth, *a.shape),
        lambda x: 1 - ssim(x, truth, *a.shape),
        lambda x: gradient_error(x, truth, *a.shape),
    ]
    values, slopes = zip(*(value_and_gradient(part, a) for part in parts))
    value, slope = value_and_gradient(lambda x: combined(x, truth, *a.shape, 0.5, 4.0, 2.0), a)
    assert value == pytest.approx(2 * values[0] + 0.5 * values[1] + 4 * values[2], rel=1e-5)
    wanted = 2 * slopes[0] + 0.5 * slopes[1] + 4 * slopes[2]
    np.testing.assert_allclose(slope, wanted, rtol=1e-4, atol=1e-5 * np.abs(wanted).max())


def test_a_loss_without_gradients_has_the_same_value():
    a, b = images(37, 53)['similar']
    plain = combined(mi.Float(a.ravel()), mi.Float(b.ravel()), 37, 53)
    assert plain.numpy()[0] == value_and_gradient(combined, a, mi.Float(b.ravel()), 37, 53)[0]


def test_sizes_must_agree():
    x = dr.zeros(mi.Float, 12)
    for loss in (
        lambda: combined(x, x, 3, 5),
        lambda: combined(x, dr.zeros(mi.Float, 4), 3, 4),
        lambda: gradient_error(x, x, 3, 5),
        lambda: tv(x, (3, 3, 3)),
    ):
        with pytest.raises(InputError):
            loss()


@pytest.mark.parametrize('shape', [(6, 5, 4), (1, 5, 4), (6, 1, 4), (6, 5, 1), (1, 1, 9), (1, 1, 1)])
def test_total_variation(shape):
    volume = np.random.default_rng(1).integers(0, 4, shape).astype(float)  # integers: some neighbours agree
    steps = [np.diff(volume, axis=i) for i in range(3)]
    count = max(sum(s.size for s in steps), 1)
    expected = np.zeros(shape)
    for axis, s in enumerate(steps):
        padding = [(int(axis == i),) * 2 for i in range(3)]
        expected -= np.diff(np.pad(np.sign(s), padding), axis=axis)
    value, gradient = value_and_gradient(lambda x: 2 * tv(x, shape), volume)
    assert value == pytest.approx(2 * sum(np.abs(s).sum() for s in steps) / count, rel=1e-6)
    np.testing.assert_allclose(gradient, 2 * expected.ravel() / count, rtol=1e-6, atol=1e-9)


def test_other_content_compiles_nothing():
    def step(seed):
        rng = np.random.default_rng(seed)
        image, truth, cube = (mi.Float(rng.random(n).tolist()) for n in (600, 600, 60))
        dr.enable_grad(image, cube)
        loss = loss_scale(image) * (combined(image, truth, 20, 30, 0.25) + 0.05 * tv(cube, (3, 4, 5)))
        dr.backward(loss)
        dr.eval(loss, dr.grad(image), dr.grad(cube))

    step(0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        step(1)
        kernels = [k for k in dr.kernel_history() if k['type'] == dr.KernelType.JIT]
    assert kernels and all(k['cache_hit'] for k in kernels)
