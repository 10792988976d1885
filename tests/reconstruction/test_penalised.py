"""Penalised least squares: proximal maps against their definitions, the minimum, the choice of the strength, bad input."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import minimize
from skimage.restoration import denoise_tv_chambolle

import lingo_mi as lm
from helpers.balls import BALL, assert_ball, ellipsoids, geometry
from lingo_mi.common.errors import InputError
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction.penalised import PATH, PenalisedLeastSquares
from lingo_mi.reconstruction.priors import TV, Denoiser, _differences, _transposed
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.system import System

SIZE = 6, 5, 4


def variation(z):
    """Isotropic total variation, with no difference beyond the last voxel."""
    d = [np.diff(z, axis=a, append=z.take([-1], a)) for a in range(3)]
    return np.sqrt(sum(x**2 for x in d)).sum()


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
    found = np.array([d.numpy().reshape(SIZE) for d in _differences(uploaded(z), SIZE)])
    expected = np.array([np.diff(z, axis=a, append=z.take([-1], a)) for a in range(3)])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    back = _transposed([uploaded(c) for c in p], SIZE).numpy().reshape(SIZE)
    assert np.vdot(found, p) == pytest.approx(np.vdot(z, back), rel=1e-5)


@pytest.mark.parametrize('upper', [np.inf, 0.7])
@pytest.mark.parametrize('strength', [0.03, 0.3])
def test_total_variation_is_the_least(noisy, strength, upper):
    """No better volume is found from there, nor from anywhere else, by a general solver on a smoothed problem."""

    def cost(z):
        return 0.5 * ((z - noisy) ** 2).sum() + strength * variation(z)

    z = prox(TV(inner=400), noisy, strength, upper)
    assert z.min() >= 0 and z.max() <= upper + 1e-6
    rng, least = np.random.default_rng(1), cost(z)
    for _ in range(200):
        other = np.clip(z + rng.choice([1e-3, 1e-2]) * rng.normal(size=SIZE), 0, upper)
        assert cost(other) > least - 1e-6

    def smoothed(flat, epsilon=1e-4):
        z = flat.reshape(SIZE)
        d = [np.diff(z, axis=a, append=z.take([-1], a)) for a in range(3)]
        return 0.5 * ((z - noisy) ** 2).sum() + strength * np.sqrt(sum(x**2 for x in d) + epsilon**2).sum()

    bounds = [(0, None if np.isinf(upper) else upper)] * noisy.size
    found = minimize(smoothed, np.full(noisy.size, 0.3), bounds=bounds, method='L-BFGS-B', options=dict(maxfun=200_000))
    assert least < cost(found.x.reshape(SIZE)) + 0.02


def test_total_variation_is_that_of_scikit_image(noisy):
    """Which has the same differences but no bounds: far above zero there are none."""
    expected = denoise_tv_chambolle(noisy + 5, weight=0.2, eps=1e-9, max_num_iter=3000)
    np.testing.assert_allclose(prox(TV(inner=500), noisy + 5, 0.2), expected, atol=2e-3)


def test_a_call_goes_on_where_the_last_one_ended(noisy):
    prior, exact = TV(inner=5), prox(TV(inner=500), noisy, 0.2)
    errors = [np.abs(prox(prior, noisy, 0.2) - exact).max() for _ in range(12)]
    assert errors[-1] < 0.2 * errors[0]
    prior.begin()
    assert np.abs(prox(prior, noisy, 0.2) - exact).max() == pytest.approx(errors[0], rel=1e-3)
    np.testing.assert_allclose(prox(prior, noisy, 0.0), np.maximum(noisy, 0), atol=1e-7)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_a_ball(mode):
    geo = geometry(mode, circular(40, start=3))
    found = run_algorithm(ellipsoids(geo, BALL), PenalisedLeastSquares(strength=1e-4, niter=150))
    assert_ball(found.volume, geo)
    assert len(found.residuals) == 151 and found.residuals[0] == 1 and found.residuals[-1] < 0.06


@pytest.fixture(scope='module')
def scan():
    """A few noisy views of a small chest, and its true volume."""
    chest = lm.phantom('chest', size=32)
    geo = lm.Geometry.cone(DSO=1000, DSD=1500, nDetector=48, dDetector=18, grid=chest.grid, angles=lm.circular(20, 360))
    data = lm.simulate(chest, geo)
    p = data.train.projections
    noise = 0.01 * p.max() * np.random.default_rng(0).normal(size=p.shape)
    return lm.Scan(geo, (p + noise).astype(np.float32)), chest.data


def test_the_minimum_does_not_depend_on_the_start(scan):
    """The problem is convex, so the least volume is one, whatever the start."""
    scan, truth = scan
    algorithm = PenalisedLeastSquares(TV(inner=40), strength=3e-4, niter=400)
    a = run_algorithm(scan, algorithm).volume
    b = run_algorithm(scan, algorithm, start=np.full(truth.shape, truth.max(), np.float32)).volume
    assert np.linalg.norm(a - b) < 0.01 * np.linalg.norm(a) and a.min() >= 0

    def cost(x):
        system = System(scan)
        scale = system.A.adjoint(system.b, system.views).numpy().max()
        r = system.b.numpy() - system.A.forward(mi.Float(x.astype(np.float32).ravel()), system.views)[0].numpy()
        return 0.5 * (r.astype(float) ** 2).sum() + 3e-4 * scale * variation(x.astype(float))

    rng, least = np.random.default_rng(1), cost(a)
    for size in (1e-3, 1e-2):
        assert cost(np.maximum(a + size * truth.max() * rng.normal(size=a.shape), 0)) > least


def test_the_strength_is_chosen(scan):
    """Near the best one of the path, of which the truth knows."""
    scan, truth = scan

    def quality(strength):
        return lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=strength), progress=False).metrics(truth)[
            'psnr_3d'
        ]

    fixed = {s: quality(s) for s in PATH}
    chosen = quality(None)
    assert chosen > max(fixed.values()) - 0.3 and chosen > min(fixed.values()) + 1
    assert 0 < max(fixed, key=fixed.get) < PATH[0]


def test_bounds_and_finer_voxels(scan):
    scan, truth = scan
    low = lm.reconstruct(
        scan, lm.PenalisedLeastSquares(strength=1e-4, niter=10, upper=0.5 * truth.max()), progress=False
    )
    assert low.volume.max() <= 0.5 * truth.max() * (1 + 1e-6) and low.volume.min() >= 0
    fine = lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=1e-4, niter=10, finer=2), start=truth, progress=False)
    assert fine.volume.shape == truth.shape and fine.grid == scan.geometry.grid
    assert fine.metrics(truth)['psnr_3d'] > 25


def test_a_denoiser_is_a_prior(scan):
    scan, truth = scan
    strengths = []

    def denoiser(volume, strength):
        strengths.append(strength)
        return denoise_tv_chambolle(volume, weight=5 * strength)

    found = lm.reconstruct(
        scan, lm.PenalisedLeastSquares(lm.Denoiser(denoiser), strength=3e-4, niter=30), progress=False
    )
    plain = lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=0.0, niter=30), progress=False)
    assert found.metrics(truth)['psnr_3d'] > plain.metrics(truth)['psnr_3d'] + 1
    assert len(strengths) == 30 and len(set(strengths)) == 1


@pytest.mark.parametrize(
    'function, message',
    [
        (lambda v, s: v[1:], 'returns the shape'),
        (lambda v, s: v * np.nan, 'NaN or infinity'),
        (lambda v, s: None, 'cannot be read as an array'),
    ],
)
def test_denoisers_that_fail(scan, function, message):
    with pytest.raises(InputError, match=message) as caught:
        lm.reconstruct(scan[0], lm.PenalisedLeastSquares(lm.Denoiser(function), strength=1e-4), progress=False)
    assert '\n' not in str(caught.value)


def test_errors_of_a_denoiser_are_its_own(scan):
    def broken(volume, strength):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        lm.reconstruct(scan[0], lm.PenalisedLeastSquares(lm.Denoiser(broken), strength=1e-4), progress=False)


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda: PenalisedLeastSquares('tv'), 'prior must be a Prior, not str; such as lm.TV()'),
        (lambda: PenalisedLeastSquares(TV), 'prior must be a Prior'),
        (lambda: PenalisedLeastSquares(strength=-1), 'strength must be from 0'),
        (lambda: PenalisedLeastSquares(strength=np.nan), 'strength must be from 0'),
        (lambda: PenalisedLeastSquares(niter=0), 'niter must be an integer from 1'),
        (lambda: PenalisedLeastSquares(upper=0), 'upper must be above 0'),
        (lambda: PenalisedLeastSquares(finer=0.5), 'finer must be an integer'),
        (lambda: PenalisedLeastSquares(held_out=1), 'held_out must be an integer from 2'),
        (lambda: TV(inner=0), 'inner must be an integer'),
        (lambda: Denoiser(3), 'cannot be called'),
    ],
)
def test_bad_options(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value) and '\n' not in str(caught.value)


def test_too_few_views(scan):
    with pytest.raises(InputError, match='at least 4'):
        lm.reconstruct(scan[0].subset([0, 5, 9]), lm.PenalisedLeastSquares(), progress=False)
