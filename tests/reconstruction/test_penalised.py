"""Penalised least squares: the minimum, weights and bounds, the choice of the strength, denoisers, bad input."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from skimage.restoration import denoise_tv_chambolle

import lingo_mi as lm
from helpers.balls import BALL, assert_ball, ellipsoids, geometry
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.geometry.trajectories import circular
from lingo_mi.reconstruction.penalised import PATH, PenalisedLeastSquares
from lingo_mi.reconstruction.priors import TV
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.system import System


def variation(z):
    """Isotropic total variation, with no difference beyond the last voxel."""
    d = [np.diff(z, axis=a, append=z.take([-1], a)) for a in range(3)]
    return np.sqrt(sum(x**2 for x in d)).sum()


@pytest.mark.thorough
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_a_ball(mode):
    geo = geometry(mode, circular(40, start=3))
    result = run_algorithm(ellipsoids(geo, BALL), PenalisedLeastSquares(strength=1e-4, niter=150))
    assert_ball(result.volume, geo)
    assert len(result.residuals) == 151 and result.residuals[0] == 1 and result.residuals[-1] < 0.06


@pytest.fixture(scope='module')
def scan():
    """A few noisy views of a small chest, and its true volume."""
    chest = lm.phantom('chest', size=32)
    geo = lm.Geometry.cone(DSO=1000, DSD=1500, nDetector=48, dDetector=18, grid=chest.grid, angles=lm.circular(20, 360))
    data = lm.simulate(chest, geo)
    p = data.train.projections
    noise = 0.01 * p.max() * np.random.default_rng(0).normal(size=p.shape)
    return lm.Scan(geo, (p + noise).astype(np.float32)), chest.data


@pytest.mark.thorough
def test_the_minimum_does_not_depend_on_the_start(scan):
    """The problem is convex, so it has one minimum, whatever the start."""
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


@pytest.mark.thorough
def test_the_strength_is_chosen(scan):
    """It is near the best one of the path, which the truth shows."""
    scan, truth = scan

    def quality(strength):
        return lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=strength), progress=False).metrics(truth)[
            'psnr_3d'
        ]

    fixed = {s: quality(s) for s in PATH}
    chosen = quality(None)
    assert chosen > max(fixed.values()) - 0.3 and chosen > min(fixed.values()) + 1
    assert 0 < max(fixed, key=fixed.get) < PATH[0]


@pytest.mark.parametrize('weights', ['equal', 'photons'])
def test_gradients_and_weights(weights):
    """With a quadratic prior, bounds and weights, the minimum is the one that SciPy finds with the same matrix."""
    geo = lm.Geometry.parallel(nDetector=(6, 9), dDetector=1, nVoxel=(5, 5, 4), dVoxel=1, angles=lm.circular(6))
    A = lm.Projector(geo)
    b = A(np.random.default_rng(0).random(A.domain_shape)) + np.random.default_rng(1).normal(size=A.range_shape)

    class Small(lm.Prior):
        curvature = 1.0

        def gradient(self, x, size):
            return x

    result = run_algorithm(
        lm.Scan(geo, b.astype(np.float32)),
        PenalisedLeastSquares(Small(), strength=0.02, niter=250, upper=0.9, weights=weights),
    )
    matrix, flat = A.aslinearoperator() @ np.eye(100, dtype=np.float32), b.astype(float).ravel()
    W = np.exp(-np.maximum(flat, 0)) if weights == 'photons' else np.ones(flat.size)
    root = np.sqrt(W / W.mean())
    strength = 0.02 * (matrix.T @ (root**2 * flat)).max()
    full = np.vstack([root[:, None] * matrix, np.sqrt(strength) * np.eye(100)])
    expected = lsq_linear(full, np.r_[root * flat, np.zeros(100)], (0, 0.9), tol=1e-12).x
    np.testing.assert_allclose(result.volume.ravel(), expected, atol=2e-4)
    assert 0 < (expected < 1e-9).sum() < 100 and (expected > 0.9 - 1e-9).any()


def test_the_scan_says_whether_photons_are_counted():
    effects = Effects(detector=Detector(photons=1e4))
    assert PenalisedLeastSquares().seeing(effects).weights == 'photons'
    assert PenalisedLeastSquares(weights='equal').seeing(effects).weights == 'equal'
    for none in (None, Effects(), Effects(detector=Detector())):
        assert PenalisedLeastSquares().seeing(none).weights == 'known'


def test_bounds_and_finer_voxels(scan):
    scan, truth = scan
    low = lm.reconstruct(
        scan, lm.PenalisedLeastSquares(strength=1e-4, niter=10, upper=0.5 * truth.max()), progress=False
    )
    assert low.volume.max() <= 0.5 * truth.max() * (1 + 1e-6) and low.volume.min() >= 0
    fine = lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=1e-4, niter=10, finer=2), start=truth, progress=False)
    assert fine.volume.shape == truth.shape and fine.grid == scan.geometry.grid
    assert fine.metrics(truth)['psnr_3d'] > 25
    parts = np.kron(truth, np.ones((2, 2, 2), np.float32))
    same = lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=1e-4, niter=10, finer=2), start=parts, progress=False)
    np.testing.assert_array_equal(same.volume, fine.volume)
    with pytest.raises(InputError, match=r'the start volume: shape \(3, 3\)'):
        lm.reconstruct(scan, lm.PenalisedLeastSquares(finer=2), start=np.ones((3, 3)), progress=False)


def test_a_denoiser_is_a_prior(scan):
    scan, truth = scan
    strengths = []

    def denoiser(volume, strength):
        strengths.append(strength)
        return denoise_tv_chambolle(volume, weight=5 * strength)

    result = lm.reconstruct(
        scan, lm.PenalisedLeastSquares(lm.Denoiser(denoiser), strength=3e-4, niter=30), progress=False
    )
    plain = lm.reconstruct(scan, lm.PenalisedLeastSquares(strength=0.0, niter=30), progress=False)
    assert result.metrics(truth)['psnr_3d'] > plain.metrics(truth)['psnr_3d'] + 1
    assert len(strengths) == 30 and len(set(strengths)) == 1


def in_place(volume, strength):
    volume *= 0.5
    return volume


def test_a_denoiser_may_work_in_place(scan):
    """In a sum, other priors use the same volume."""
    volumes = [
        lm.reconstruct(
            scan[0],
            lm.PenalisedLeastSquares(lm.PriorSum((lm.Denoiser(f), TV())), strength=1e-4, niter=3),
            progress=False,
        ).volume
        for f in (in_place, lambda v, s: 0.5 * v)
    ]
    np.testing.assert_array_equal(*volumes)


class Wrong(lm.Prior):
    """A prior whose map returns something else."""

    def __init__(self, returned):
        self.returned = returned

    def prox(self, x, strength, size, upper=np.inf):
        return self.returned(x)


@pytest.mark.parametrize(
    'returned, message',
    [
        (lambda x: mi.Float([1, 2]), 'the prior Wrong: prox returns 2 of 32768 voxels'),
        (lambda x: x * np.nan, 'the prior Wrong returns NaN or infinity'),
    ],
)
def test_priors_that_fail(scan, returned, message):
    with pytest.raises(InputError, match=message):
        lm.reconstruct(scan[0], lm.PenalisedLeastSquares(Wrong(returned), strength=1e-4), progress=False)


def test_priors_that_need_more_memory(scan):
    """TGV holds three fields and six slopes, and a sum holds the state of all parts."""

    def memory(*priors, finer=1):
        return lm.estimate(scan[0], lm.PenalisedLeastSquares(lm.PriorSum(priors), finer=finer)).memory

    assert memory(TV()) < memory(lm.TGV()) < memory(lm.TGV(), TV()) < memory(lm.TGV(), lm.TGV())
    assert memory(lm.TGV(), finer=2) > 6 * memory(lm.TGV())
    best = [lm.estimate(scan[0], lm.Best(finer=1, prior=prior)).memory for prior in (None, TV(), lm.TGV())]
    assert best == sorted(best) and best[0] < best[1] < best[2]


@pytest.mark.parametrize(
    'function, message',
    [
        (lambda v, s: v[1:], 'returns the shape'),
        (lambda v, s: v * np.nan, 'NaN or infinity'),
        (lambda v, s: None, 'cannot be read as an array'),
        (lambda v, s: 1 / 0, 'the denoiser fails: ZeroDivisionError: division by zero'),
    ],
)
def test_denoisers_that_fail(scan, function, message):
    with pytest.raises(InputError, match=message) as caught:
        lm.reconstruct(scan[0], lm.PenalisedLeastSquares(lm.Denoiser(function), strength=1e-4), progress=False)
    assert '\n' not in str(caught.value)


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
        (lambda: PenalisedLeastSquares(weights='noise'), "weights must be one of known, photons, equal, not 'noise'"),
    ],
)
def test_bad_options(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value) and '\n' not in str(caught.value)


def test_too_few_views(scan):
    with pytest.raises(InputError, match='at least 4'):
        lm.reconstruct(scan[0].subset([0, 5, 9]), lm.PenalisedLeastSquares(), progress=False)
