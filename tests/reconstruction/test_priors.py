"""Priors: proximal maps against their definitions, gradients against differences, other programs, bad input."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from scipy.optimize import minimize
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction.priors import TGV, TV, Denoiser, DirectionalTV, Huber, NonLocalMeans, Prior, PriorSum
from lingo_mi.reconstruction.priors.differences import differences, transposed
from lingo_mi.reconstruction.priors.generalised_variation import _slopes, _slopes_transposed

SIZE = 6, 5, 4


def prox(prior, x, strength, upper=np.inf):
    x = uploaded(x)
    dr.eval(x)
    return prior.prox(x, strength, SIZE, upper).numpy().reshape(SIZE)


@pytest.fixture
def noisy():
    blocks = np.zeros(SIZE)
    blocks[:3], blocks[3:, :2] = 1.0, 0.4
    return (blocks + 0.2 * np.random.default_rng(0).normal(size=SIZE)).astype(np.float32)


def test_differences_and_their_transpose():
    rng = np.random.default_rng(0)
    z, p = rng.normal(size=SIZE).astype(np.float32), rng.normal(size=(3, *SIZE)).astype(np.float32)
    actual = np.array([d.numpy().reshape(SIZE) for d in differences(uploaded(z), SIZE)])
    expected = np.array([np.diff(z, axis=a, append=z.take([-1], a)) for a in range(3)])
    np.testing.assert_allclose(actual, expected, atol=1e-6)
    back = transposed([uploaded(c) for c in p], SIZE).numpy().reshape(SIZE)
    assert np.vdot(actual, p) == pytest.approx(np.vdot(z, back), rel=1e-5)


@pytest.mark.parametrize('upper', [np.inf, 0.7])
@pytest.mark.parametrize('strength', [0.03, 0.3])
def test_total_variation_is_the_least(noisy, strength, upper):
    def cost(flat):
        z = np.clip(flat.reshape(SIZE), 0, upper)
        return 0.5 * ((z - noisy) ** 2).sum() + strength * lengths(steps(z))

    z = prox(TV(inner=400), noisy, strength, upper)
    assert z.min() >= 0 and z.max() <= upper + 1e-6
    assert_least(cost, z.ravel(), z.size)


def test_total_variation_is_that_of_scikit_image(noisy):
    """scikit-image has the same differences but no bounds, which have no effect far above zero."""
    expected = denoise_tv_chambolle(noisy + 5, weight=0.2, eps=1e-9, max_num_iter=3000)
    np.testing.assert_allclose(prox(TV(inner=500), noisy + 5, 0.2), expected, atol=2e-3)


def test_a_call_goes_on_where_the_last_one_ended(noisy):
    prior, exact = TV(inner=5), prox(TV(inner=500), noisy, 0.2)
    errors = [np.abs(prox(prior, noisy, 0.2) - exact).max() for _ in range(12)]
    assert errors[-1] < 0.2 * errors[0]
    prior.begin()
    assert np.abs(prox(prior, noisy, 0.2) - exact).max() == pytest.approx(errors[0], rel=1e-3)
    np.testing.assert_allclose(prox(prior, noisy, 0.0), np.maximum(noisy, 0), atol=1e-7)


TINY = 4, 3, 2


def steps(z):
    return np.array([np.diff(z, axis=a, append=z.take([-1], a)) for a in range(3)])


def lengths(d, epsilon=1e-3):
    """The sum of the lengths of vectors, a little smoothed, so that a general solver can go down from anywhere."""
    return np.sqrt((d**2).sum(0) + epsilon**2).sum() - epsilon * d[0].size


def assert_least(cost, actual, bounded):
    """Require the minimum of a convex function: a general solver gets no lower from there, nor do random steps. The first
    `bounded` unknowns are not negative."""
    bounds = [(0, None)] * bounded + [(None, None)] * (actual.size - bounded)
    lower = minimize(cost, actual.astype(float), bounds=bounds, method='L-BFGS-B', options=dict(maxfun=2500))
    assert cost(actual) < lower.fun * 1.002
    rng = np.random.default_rng(1)
    for size in [0.003] * 100 + [0.03] * 100:
        other = actual + size * rng.normal(size=actual.size)
        other[:bounded] = np.maximum(other[:bounded], 0)
        assert cost(other) > cost(actual) * 0.9998


def tiny_prox(prior, x, strength):
    x = uploaded(x)
    dr.eval(x)
    return prior.prox(x, strength, TINY).numpy().reshape(TINY)


@pytest.fixture
def tiny():
    ramp = np.zeros(TINY)
    ramp[2:], ramp[:, 1:] = 1.0, 0.5
    return (ramp + 0.2 * np.random.default_rng(0).normal(size=TINY)).astype(np.float32)


def along(direction, weight):
    n = np.array(direction) / np.linalg.norm(direction)
    return lambda z: np.tensordot(np.eye(3) + (weight - 1) * np.outer(n, n), steps(z), 1)


@pytest.mark.parametrize('weight', [0.3, 3.0])
def test_directional_total_variation_is_the_least(tiny, weight):
    field = along((1, 2, 0), weight)
    actual = tiny_prox(DirectionalTV(inner=300, direction=(1, 2, 0), weight=weight), tiny, 0.1)
    assert_least(
        lambda z: 0.5 * ((z - tiny.ravel()) ** 2).sum() + 0.1 * lengths(field(z.reshape(TINY))), actual.ravel(), 24
    )
    plain = tiny_prox(TV(inner=200), tiny, 0.1)
    assert np.abs(actual - plain).max() > 0.02
    np.testing.assert_allclose(tiny_prox(DirectionalTV(inner=200, weight=1.0), tiny, 0.1), plain, atol=1e-5)


def second_derivatives(v):
    """The symmetric derivative [9, x, y, z] of a field on the edges between voxels, where both ends of a derivative exist."""
    out = np.zeros((3, 3, *TINY))
    for c in range(3):
        inside = tuple(slice(0, n - 1) if a == c else slice(None) for a, n in enumerate(TINY))
        edges = v[c][inside]
        for a in range(3):
            d = np.diff(edges, axis=a)
            out[a, c][tuple(map(slice, d.shape))] = d
    return 0.5 * (out + out.swapaxes(0, 1)).reshape(9, *TINY)


def edges_only(v):
    v = v.copy()
    for c in range(3):
        v[c][tuple(slice(-1, None) if a == c else slice(None) for a in range(3))] = 0
    return v


def test_generalised_variation_is_the_least(tiny):
    def cost(flat):
        z, v = flat[:24].reshape(TINY), edges_only(flat[24:].reshape(3, *TINY))
        return 0.5 * ((z - tiny) ** 2).sum() + 0.1 * lengths(steps(z) - v) + 0.15 * lengths(second_derivatives(v))

    prior = TGV(second=1.5, inner=600)
    actual = tiny_prox(prior, tiny, 0.1)
    field = np.concatenate([c.numpy() for c in prior._state[0]])
    assert_least(cost, np.r_[actual.ravel(), field], 24)
    assert np.abs(actual - tiny_prox(TV(inner=200), tiny, 0.1)).max() > 0.01


def test_slopes_cost_nothing():
    ramp = np.add.outer(np.add.outer(np.arange(6), 2.0 * np.arange(5)), np.arange(4)).astype(np.float32) + 1
    np.testing.assert_allclose(prox(TGV(inner=600), ramp, 0.3), ramp, atol=0.01)
    assert np.abs(prox(TV(inner=100), ramp, 0.3) - ramp).max() > 0.1


def test_slopes_and_their_transpose():
    rng = np.random.default_rng(0)
    v, q = (rng.normal(size=(n, *SIZE)).astype(np.float32) for n in (3, 6))
    up = [uploaded(c) for c in v], [uploaded(c) for c in q]
    dr.eval(up)
    forward = np.array([c.numpy().reshape(SIZE) for c in _slopes(up[0], SIZE)])
    back = np.array([c.numpy().reshape(SIZE) for c in _slopes_transposed(up[1], SIZE)])
    assert np.vdot(forward, q) == pytest.approx(np.vdot(v, back), rel=1e-4)


def test_the_gradient_of_huber(noisy):
    """It agrees with central differences of a float64 definition, and `curvature` is a bound."""
    prior, delta = Huber(delta=0.15), 0.15

    def cost(z):
        d = np.sqrt((steps(z) ** 2).sum(0))
        return np.where(d < delta, d**2 / (2 * delta), d - delta / 2).sum()

    def gradient(z):
        x = uploaded(z.astype(np.float32))
        dr.eval(x)
        return prior.gradient(x, SIZE).numpy().reshape(SIZE)

    rng, z = np.random.default_rng(1), noisy.astype(float)
    g = gradient(z)
    for _ in range(20):
        d = rng.normal(size=SIZE)
        assert np.vdot(g, d) == pytest.approx((cost(z + 1e-5 * d) - cost(z - 1e-5 * d)) / 2e-5, rel=1e-3, abs=1e-3)
        assert np.linalg.norm(gradient(z + 0.01 * d) - g) <= prior.curvature * np.linalg.norm(0.01 * d)


@pytest.mark.parametrize('shifts', [False, True])
def test_wavelets_are_a_soft_threshold(noisy, shifts):
    """The result minimises squares plus absolute coefficients, by the condition on the subgradient."""
    pywt = pytest.importorskip('pywt')
    x = np.pad(noisy, [(0, -n % 4) for n in SIZE], mode='edge') + 2  # far above zero, where there are no bounds
    prior = lm.Wavelets('db2', level=2, shifts=shifts)
    up = uploaded(x)
    dr.eval(up)
    z = prior.prox(up, 0.1, x.shape).numpy().reshape(x.shape)
    offset = np.random.default_rng(0).integers(0, 4, 3) if shifts else (0, 0, 0)

    def coefficients(v):
        decomposed = pywt.wavedecn(np.roll(v, offset, (0, 1, 2)), 'db2', 'periodization', 2)
        return decomposed[0], np.concatenate([c.ravel() for scale in decomposed[1:] for c in scale.values()])

    (coarse, fine), (coarse_z, fine_z) = coefficients(x), coefficients(z)
    np.testing.assert_allclose(coarse, coarse_z, atol=1e-4)
    few = np.abs(fine_z) < 1e-4
    assert 0.1 < few.mean() < 0.98 and np.abs(fine - fine_z).max() < 0.1 + 1e-4
    np.testing.assert_allclose((fine - fine_z)[~few], 0.1 * np.sign(fine_z[~few]), atol=1e-4)
    assert prox(prior, noisy, 0.1).shape == SIZE  # whose sides are not multiples of 4


def test_non_local_means_are_those_of_scikit_image(noisy):
    expected = denoise_nl_means(noisy + 1, 3, 2, h=0.2)
    np.testing.assert_allclose(prox(NonLocalMeans(distance=2), noisy + 1, 0.2), expected, atol=1e-6)
    np.testing.assert_array_equal(prox(NonLocalMeans(), noisy + 1, 0.0), noisy + 1)


def test_a_sum_is_the_least(tiny):
    field = along((0, 1, 0), 4.0)

    def cost(z):
        z = z.reshape(TINY)
        return 0.5 * ((z - tiny) ** 2).sum() + 0.05 * lengths(steps(z)) + 0.025 * lengths(field(z))

    parts = TV(inner=20), DirectionalTV(inner=20, direction=(0, 1, 0), weight=4.0), Huber(0.1)
    actual = tiny_prox(PriorSum(parts, weights=(1, 0.5, 2), inner=30), tiny, 0.05)
    assert_least(cost, actual.ravel(), 24)


def test_a_sum_of_one_and_of_gradients(noisy):
    x = uploaded(noisy)
    dr.eval(x)
    both = PriorSum((Huber(0.1), Huber(0.3), TV(inner=9)), weights=(1, 0.5, 2))
    parts = [Huber(d).gradient(x, SIZE).numpy() for d in (0.1, 0.3)]
    np.testing.assert_allclose(both.gradient(x, SIZE).numpy(), parts[0] + 0.5 * parts[1], rtol=1e-5, atol=1e-6)
    assert both.curvature == pytest.approx(12 / 0.1 + 0.5 * 12 / 0.3)
    np.testing.assert_array_equal(prox(both, noisy, 0.1), prox(TV(inner=9), noisy, 0.2))
    np.testing.assert_array_equal(prox(PriorSum((Huber(0.1),)), noisy, 0.1), np.maximum(noisy, 0))
    assert PriorSum((TV(),)).gradient(x, SIZE) is None and Prior().gradient(x, SIZE) is None


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda: TV(inner=0), 'inner must be an integer'),
        (lambda: DirectionalTV(direction=(0, 0, 0)), 'direction must be three numbers, not all zero'),
        (lambda: DirectionalTV(direction=3), 'direction must be three numbers'),
        (lambda: DirectionalTV(weight=0), 'weight must be above 0'),
        (lambda: Huber(0), 'delta must be above 0'),
        (lambda: TGV(second=-1), 'second must be above 0'),
        (lambda: TGV(inner=0), 'inner must be an integer'),
        (lambda: NonLocalMeans(patch=2), 'patch must be odd'),
        (lambda: NonLocalMeans(distance=0), 'distance must be an integer'),
        (lambda: Denoiser(3), 'cannot be called'),
        (lambda: PriorSum(()), 'give at least one'),
        (lambda: PriorSum(TV()), 'priors must be a Sequence'),
        (lambda: PriorSum((TV(), 3)), 'priors must be a Prior, not int'),
        (lambda: PriorSum((TV(),), weights=(1, 2)), 'one for each of the 1 priors, not 2'),
        (lambda: PriorSum((TV(),), weights=(0,)), 'weights must be above 0'),
        (lambda: PriorSum((TV(),), weights=1), 'weights must be a Sequence or a ndarray'),
    ],
)
def test_bad_options(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value) and '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'wavelet, level, message', [('bior2.2', 1, 'orthogonal'), ('x', 1, 'orthogonal'), ('db2', 0, 'level')]
)
def test_bad_wavelets(wavelet, level, message):
    pytest.importorskip('pywt')
    with pytest.raises(InputError, match=message):
        lm.Wavelets(wavelet, level=level)
