"""SART, OS-SART, SIRT, CGLS and ASD-POCS: literal transcriptions on a small system, bad input."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import lsqr

from helpers.algorithms import ITERATIVE
from helpers.grids import scan as small
from helpers.matrices import matrix
from lingo_mi import phantoms
from lingo_mi.common.errors import InputError
from lingo_mi.completion.views import complete_views
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import psnr_3d_r2
from lingo_mi.phantoms.x3d_scan import default_geometry
from lingo_mi.projectors.grid import project_volume
from lingo_mi.reconstruction import ASDPOCS, CGLS, FDK, OSSART, SART, SIRT, Refined
from lingo_mi.reconstruction.refined import structure
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.sart import blocks
from lingo_mi.reconstruction.system import System
from lingo_mi.reconstruction.tv_descent import tv_floor, tv_gradient
from lingo_mi.scan import Scan


@pytest.fixture(scope='module')
def system():
    """A scan with noise, its matrix [view, pixels, voxels] and its projections [view, pixels], float64."""
    geo = small(n=5)
    A, rng = matrix(geo), np.random.default_rng(0)
    truth = np.maximum(rng.normal(0.3, 1, A.shape[1]), 0)
    b = A @ truth + rng.normal(0, 2, A.shape[0])
    scan = Scan(geo, b.reshape(5, *geo.nDetector))
    return scan, A.reshape(5, -1, A.shape[1]), scan.projections.reshape(5, -1).astype(float)


def divide(a, b):
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


def sart_pass(x, A, b, lmbda, parts, noneg=True, s=None):
    """One pass of SART as Andersen and Kak write it, for z in x + diag(s) z."""
    s = np.ones_like(x) if s is None else s
    for part in parts:
        rows, data = np.concatenate(A[part]), np.concatenate(b[part])
        scaled = rows * s
        x = x + s * lmbda * divide(scaled.T @ divide(data - rows @ x, scaled.sum(1)), scaled.sum(0))
        x = np.maximum(x, 0) if noneg else x
    return x


def close(result, expected):
    np.testing.assert_allclose(result.volume.ravel(), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize('blocksize, noneg', [(1, True), (2, True), (2, False), (5, True)])
def test_sart_is_the_transcription(system, blocksize, noneg):
    scan, A, b = system
    start = np.random.default_rng(1).random(scan.geometry.grid.shape)
    result = run_algorithm(scan, OSSART(3, blocksize, 0.8, 0.9, noneg, 'ordered', tol=1e-9), start=start)
    without = run_algorithm(scan, OSSART(3, blocksize, 0.8, 0.9, noneg, 'ordered'), start=start)
    x = start.ravel()
    expected = [np.linalg.norm(A @ x - b) / np.linalg.norm(b)]
    for k in range(3):
        x = sart_pass(
            x, A, b, 0.8 * 0.9**k, [np.arange(i, min(i + blocksize, 5)) for i in range(0, 5, blocksize)], noneg
        )
        expected.append(np.linalg.norm(A @ x - b) / np.linalg.norm(b))
    close(result, x)
    np.testing.assert_allclose(result.residuals, expected, rtol=1e-4)
    np.testing.assert_array_equal(without, result)
    np.testing.assert_array_equal(without.residuals, [result.residuals[0], np.nan, np.nan, result.residuals[3]])
    assert (result.volume.min() < 0) != noneg


@pytest.mark.parametrize('blocksize', [1, 2])
def test_weighted_sart_is_that_of_the_scaled_system(system, blocksize):
    """Zero weights change nothing, and a common factor of all weights has no effect."""
    scan, A, b = system
    rng = np.random.default_rng(1)
    start, s = rng.random(scan.geometry.grid.shape), rng.random(scan.geometry.grid.shape) ** 3
    s[:2], x = 0, start.ravel()
    for k in range(3):
        x = sart_pass(
            x, A, b, 0.8 * 0.9**k, [np.arange(i, min(i + blocksize, 5)) for i in range(0, 5, blocksize)], s=s.ravel()
        )
    for factor in (1, 1e-3):
        result = run_algorithm(scan, OSSART(3, blocksize, 0.8, 0.9, True, 'ordered'), start=start, weights=factor * s)
        close(result, x)
        np.testing.assert_array_equal(result.volume[:2], np.float32(start[:2]))
    ones = np.full_like(s, 3)
    two = ASDPOCS(2)
    np.testing.assert_allclose(run_algorithm(scan, two, weights=ones), run_algorithm(scan, two), atol=1e-5)
    change = run_algorithm(scan, two, start=start, weights=s).volume - run_algorithm(scan, two, start=start).volume
    assert np.abs(change).max() > 0.1


@pytest.mark.parametrize('value, why', [(np.nan, 'NaN'), (-1, 'negative')])
def test_weights_that_are_none(system, value, why):
    shape = system[0].geometry.grid.shape
    for weights, reason in ((np.full(shape, value), why), (np.ones((2, *shape[1:])), 'shape')):
        with pytest.raises(InputError, match=f'weights.*{reason}'):
            run_algorithm(system[0], SART(1), weights=weights)


def test_blurred_sart_is_the_transcription(system):
    """The change of a pass is blurred, and then negative densities are set to zero."""
    scan, A, b = system
    start, deviations = np.random.default_rng(1).random(scan.geometry.grid.shape), (0.7, 0.5, 0.6)
    for noneg in (True, False):
        x = start.ravel()
        for k in range(3):
            change = sart_pass(x, A, b, 0.8 * 0.9**k, [np.arange(i, i + 1) for i in range(5)], noneg) - x
            change = gaussian_filter(change.reshape(start.shape), deviations, radius=[int(4 * s) for s in deviations])
            x = np.maximum(x + change.ravel(), 0) if noneg else x + change.ravel()
        close(run_algorithm(scan, SART(3, 0.8, 0.9, noneg, 'ordered'), start=start, blur=deviations), x)
    np.testing.assert_array_equal(run_algorithm(scan, SIRT(2), blur=(0, 0, 0)), run_algorithm(scan, SIRT(2)))
    plain, soft = (
        run_algorithm(scan, ASDPOCS(1, lmbda=1e-3, tviter=1, alpha=1e-9), start=start, blur=s).volume
        for s in (None, deviations)
    )
    np.testing.assert_allclose(soft - start, gaussian_filter(plain - start, deviations), atol=2e-5)
    assert np.abs(plain - soft).max() > 1e-4


@pytest.mark.parametrize('blur', [(1, 1), (1, -1, 1), (1, np.nan, 1), (1, 1, np.inf)])
def test_a_blur_that_is_none(system, blur):
    with pytest.raises(InputError, match='blur must be'):
        run_algorithm(system[0], SART(1), blur=blur)


def test_names_of_the_family(system):
    scan, _, _ = system
    np.testing.assert_array_equal(
        run_algorithm(scan, SIRT(2)), run_algorithm(scan, OSSART(2, 5, OrderStrategy='ordered'))
    )
    np.testing.assert_array_equal(run_algorithm(scan, SART(2)), run_algorithm(scan, OSSART(2, 1)))
    assert np.abs(run_algorithm(scan, SART(1)).volume - run_algorithm(scan, SART(1, seed=1)).volume).max() > 0


def test_orders():
    angles, rng = circular(10), np.random.default_rng(0)
    assert [list(p) for p in blocks(angles, 4, 'ordered', rng)] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    drawn = blocks(angles, 1, 'random', rng)
    assert sorted(np.concatenate(drawn)) == list(range(10)) and np.any(np.diff(np.concatenate(drawn)) != 1)
    spread = np.concatenate(blocks(circular(8), 1, 'angularDistance', rng))
    assert list(spread[:2]) == [0, 4] and set(spread[2:4]) == {2, 6} and sorted(spread) == list(range(8))


@pytest.mark.parametrize('strategy', ['ordered', 'random', 'angularDistance'])
def test_order_strategy(system, strategy):
    """SART visits the views as `blocks` says, drawn anew every pass."""
    scan, A, b = system
    rng, x = np.random.default_rng(3), np.zeros(A.shape[2])
    blocks(scan.geometry.angles, 1, strategy, rng)  # the first draw is for a check of the name
    for _ in range(2):
        x = sart_pass(x, A, b, 0.8, blocks(scan.geometry.angles, 1, strategy, rng))
    close(run_algorithm(scan, SART(2, 0.8, 1.0, OrderStrategy=strategy, seed=3)), x)


@pytest.mark.parametrize('name', ['sart', 'sirt', 'asd-pocs'])
def test_noneg(system, name):
    scan = replace(system[0], projections=system[0].projections - system[0].projections.mean())
    bounded, free = (run_algorithm(scan, ITERATIVE[name](niter=2, noneg=noneg)).volume for noneg in (True, False))
    assert free.min() < -0.1 * free.max()
    assert bounded.min() >= (-0.01 * bounded.max() if name == 'asd-pocs' else 0)  # whose descent comes after


def test_cgls_is_lsqr_and_its_residual_falls(system):
    scan, A, b = system
    result = run_algorithm(scan, CGLS(12))
    expected = lsqr(A.reshape(-1, A.shape[2]), b.ravel(), iter_lim=12, atol=0, btol=0, conlim=0)[0]
    np.testing.assert_allclose(result.volume.ravel(), expected, atol=2e-3 * np.abs(expected).max())
    assert len(result.residuals) == 13 and np.all(np.diff(result.residuals) < 0)
    np.testing.assert_allclose(result.residuals[-1], np.linalg.norm(A @ expected - b) / np.linalg.norm(b), rtol=1e-4)
    start = np.random.default_rng(2).random(scan.geometry.grid.shape)
    shifted = Scan(scan.geometry, (b - A @ start.ravel()).reshape(scan.projections.shape))
    close(run_algorithm(scan, CGLS(4), start=start), start.ravel() + run_algorithm(shifted, CGLS(4)).volume.ravel())


def squared_gradient(x):
    return sum(np.diff(x, axis=a, prepend=x.take([0], a)) ** 2 for a in range(3))


def total_variation(x, epsilon):
    """Sidky and Pan, equation 3, with backward differences that are zero at the border."""
    square = squared_gradient(x)
    return np.sqrt(square + epsilon * square.max() if epsilon < 1e-3 else square + epsilon).sum()


def tv_slope(x, floor):
    """The derivative of `total_variation`, term by term."""
    d = [np.diff(x, axis=a, prepend=x.take([0], a)) for a in range(3)]
    w = [v / np.sqrt(sum(v**2 for v in d) + floor) for v in d]
    return sum(
        v - np.append(v, np.zeros_like(v.take([0], a)), a).take(np.arange(1, v.shape[a] + 1), a)
        for a, v in enumerate(w)
    )


def test_tv_gradient():
    x = np.random.default_rng(0).random((5, 4, 6))
    expected = tv_slope(x, 1e-8 * squared_gradient(x).max())
    volume = mi.Float(np.float32(x).ravel())
    result = tv_gradient(volume, x.shape, tv_floor(volume, x.shape)).numpy()
    np.testing.assert_allclose(result, expected.ravel(), atol=2e-5)
    rng = np.random.default_rng(1)
    direction = 1e-5 * rng.normal(size=x.shape)
    change = total_variation(x + direction, 1e-8) - total_variation(x - direction, 1e-8)
    assert abs(change / 2 - (expected * direction).sum()) < 1e-4 * abs(change)
    even = dr.full(mi.Float, 3.0, 120)
    assert not tv_gradient(even, x.shape, tv_floor(even, x.shape)).numpy().any()


def test_asd_pocs_is_the_transcription(system):
    scan, A, b = system
    shape, maxl2err = scan.geometry.grid.shape, 0.05 * np.linalg.norm(b)
    result = run_algorithm(scan, ASDPOCS(4, 2, 0.9, 0.95, 5, 0.2, 0.5, 0.6, maxl2err, OrderStrategy='ordered'))
    x, lmbda, step, errors, decides = np.zeros(A.shape[2]), 0.9, None, [], []
    for _ in range(4):
        start = x
        x = sart_pass(x, A, b, lmbda, [np.arange(0, 2), np.arange(2, 4), np.arange(4, 5)])
        errors.append(np.linalg.norm(A @ x - b))
        data = np.linalg.norm(x - start)
        step = 0.2 * data if step is None else step
        start, floor = x, 1e-8 * squared_gradient(x.reshape(shape)).max()
        for _ in range(5):
            slope = tv_slope(x.reshape(shape), floor).ravel()
            x = x - step * slope / np.linalg.norm(slope)
        decides.append(np.linalg.norm(x - start) > 0.6 * data)
        if decides[-1] and errors[-1] > maxl2err:
            step *= 0.5
        lmbda *= 0.95
    computed = np.isfinite(actual := np.array(result.residuals[1:]))
    assert computed.tolist() == [*decides[:-1], True] and not all(decides[:-1])
    np.testing.assert_allclose(actual[computed], np.array(errors)[computed] / np.linalg.norm(b), rtol=1e-3)
    np.testing.assert_allclose(result.volume.ravel(), x, atol=2e-3 * np.abs(x).max())


@pytest.mark.parametrize('share', [1.0, 0.95])
def test_asd_pocs_meets_exact_line_integrals(share):
    """With the correction for Joseph's error, the volume's exact line integrals meet the projections; without it, Joseph's do.

    share   of the pixels that are valid
    """
    geo, rng = small(n=12), np.random.default_rng(0)
    projections = project_volume(rng.random(geo.grid.shape), geo)
    valid = rng.random(projections.shape) < share
    scan = Scan(geo, projections, None if share == 1 else valid)
    missed = [
        np.linalg.norm(
            (project_volume(run_algorithm(scan, ASDPOCS(80, alpha=1e-6, exact_every=n)).volume, geo) - projections)[
                valid
            ]
        )
        for n in (0, 2)
    ]
    assert missed[1] < 0.2 * missed[0]


def test_asd_pocs_stops(system):
    scan, _, _ = system
    assert len(run_algorithm(scan, ASDPOCS(50, 5, 0.01, 0.8, maxl2err=1.0)).residuals) == 1 + 4  # 0.01 * 0.8^4 < 0.005
    met = dict(tviter=5, alpha=0.02, lmbda_red=1.0, alpha_red=1.0, maxl2err=1e9, OrderStrategy='ordered')
    assert (
        len(run_algorithm(scan, ASDPOCS(100, 5, **met)).residuals) < 100
    )  # the data are met at once: the steps come to undo each other
    assert len(run_algorithm(scan, ASDPOCS(100, 5, **{**met, 'maxl2err': 1e-9})).residuals) == 101


@pytest.mark.parametrize('name', ITERATIVE)
@pytest.mark.parametrize('value', [0.0, 1.0, -1.0])
def test_constant_projections(name, value):
    geo = small(n=2)
    scan = Scan(geo, np.full((2, *geo.nDetector), value))
    result = ITERATIVE[name](niter=2)._run(scan)  # `run_algorithm` refuses a scan without signal
    assert np.isfinite(result.volume).all() and np.isfinite([result.residuals[0], result.residuals[-1]]).all()
    assert result.volume.dtype == np.float32 and result.volume.shape == geo.grid.shape
    if name != 'cgls' and value <= 0 and name != 'asd-pocs':
        assert not result.volume.any()


@pytest.mark.parametrize('name', ITERATIVE)
def test_bad_input(name):
    scan = Scan(small(n=2), np.ones((2, 17, 21)))
    make = ITERATIVE[name]
    with pytest.raises(InputError, match='niter'):
        make(niter=0)
    with pytest.raises(InputError, match='nVoxel'):
        run_algorithm(scan, make(), start=np.zeros((3, 3, 3)))
    with pytest.raises(InputError, match='NaN'):
        run_algorithm(scan, make(), start=np.full((9, 11, 7), np.nan))
    if name not in ('cgls', 'pls'):
        with pytest.raises(InputError, match='lmbda'):
            make(lmbda=3.0)
    if name in ('sart', 'os-sart', 'asd-pocs'):
        with pytest.raises(
            InputError, match='OrderStrategy .sorted. is unknown: use one of ordered, random, angularDistance'
        ):
            make(OrderStrategy='sorted')
    if name == 'asd-pocs':
        with pytest.raises(InputError, match='exact_every'):
            make(exact_every=-1)
    for parameter, values in (
        ('seed', (-1,)),
        ('tol', (np.nan, -1.0, np.inf)),
        ('maxl2err', (np.nan, -1.0, np.inf)),
        ('alpha', (np.nan, 0.0, np.inf, 1e30)),
        ('rmax', (np.inf,)),
        ('niter', (np.inf, np.nan)),
    ):
        for value in values if parameter in make().options else ():
            with pytest.raises(InputError, match=f'{parameter} must be'):
                make(**{parameter: value})
    calls = []
    run_algorithm(scan, make(niter=2), progress=lambda *a: calls.append(a))
    assert [c[:2] for c in calls] == [(1, 2), (2, 2)]
    assert calls[-1][2] is None if make is ASDPOCS else np.isfinite(calls[-1][2])


@pytest.mark.parametrize('algorithm', [SART(), CGLS(), ASDPOCS()])
def test_what_is_not_finite_is_no_result(algorithm):
    with pytest.raises(InputError, match='not finite'):
        run_algorithm(Scan(small(n=2), np.full((2, 17, 21), 1e25)), algorithm)


@pytest.mark.parametrize(
    'wrong',
    [
        dict(alpha=np.inf),
        dict(seed=-1),
        dict(maxl2err=np.nan),
        dict(exact_every=-1),
        dict(finer=0),
        dict(finer=1.5),
        dict(completed_niter=-1),
    ],
)
def test_refined_checks_before_its_passes(wrong):
    with pytest.raises(InputError, match=f'{next(iter(wrong))} must be'):
        Refined(**wrong)


def test_structure_is_where_a_volume_changes():
    volume = np.zeros((12, 10, 8), np.float32)
    volume[6:] = 2  # between slices 5 and 6 along x: differences of 1 at both
    weights = structure(volume)
    assert weights.dtype == np.float32 and weights.shape == volume.shape
    np.testing.assert_allclose(weights[5:7] ** 2, 0.3989 + 0.2420, rtol=1e-3)  # of a Gaussian
    assert weights[5].min() > weights[3].max() > weights[0].max()
    np.testing.assert_allclose(weights[0], 0.05 * np.sqrt(np.mean(structure(volume) ** 2)), rtol=0.02)
    np.testing.assert_allclose(structure(3 * volume), 3 * weights, rtol=1e-6)
    np.testing.assert_array_equal(structure(volume + 1), weights)
    np.testing.assert_array_equal(structure(np.ones((4, 4, 4), np.float32)), 1)
    assert structure(volume[:, :, :1]).max() > 0.5  # a single slice


def test_refined_puts_what_is_missing_where_the_structure_is():
    """If the start is blurred, like a cloud's volume, the weights recover more of what is missing than equal weights do."""
    made = phantoms.make('foot', 48)
    geo = default_geometry(made, circular(12, 180.0), 96)
    scan = Scan(geo, project_volume(made.data, geo))
    start = np.asarray(gaussian_filter(made.data, 1), np.float32)
    volume = run_algorithm(scan, Refined(4, 0, 1), completed=scan, sample=lambda _: start).volume
    alike = ASDPOCS(4, tviter=1, alpha=0.12, alpha_red=0.87, rmax=0.65, maxl2err=0.0, exact_every=5)
    alike = run_algorithm(scan, alike, start=start).volume
    assert psnr_3d_r2(volume, made.data) > psnr_3d_r2(alike, made.data) + 1, [
        psnr_3d_r2(v, made.data) for v in (volume, alike, start)
    ]


def test_smaller_voxels_hold_what_an_object_has_between_them():
    """The object has detail of half a voxel. `refined` on voxels of half the size, whose means it gives, is better than on the
    scan's, though its start is not."""
    made = phantoms.make('foot', 48)
    geo = default_geometry(made, circular(30, 180.0), 96)
    scan = Scan(geo, project_volume(made.data, geo))
    means = made.data.reshape(24, 2, 24, 2, 24, 2).mean((1, 3, 5))
    coarse = scan.on(Grid(means.shape, [2 * d for d in geo.grid.spacing], geo.grid.centre))

    def sample(grid):
        return np.kron(means, np.ones(np.array(grid.shape) // means.shape))

    result = [
        psnr_3d_r2(run_algorithm(coarse, Refined(3, 1, 5, finer=finer), completed=coarse, sample=sample).volume, means)
        for finer in (1, 2)
    ]
    assert result[1] > result[0] + 3, result


def test_no_kernel_is_compiled_after_the_first_iterations(system):
    scan, _, _ = system
    runs = [
        lambda: run_algorithm(scan, SART(3)),
        lambda: run_algorithm(scan, SART(3), blur=(0.5, 0.5, 0.5)),
        lambda: run_algorithm(scan, CGLS(3)),
        lambda: run_algorithm(scan, ASDPOCS(3, 2)),
    ]
    for run in runs:
        run()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for run in runs:
            run()
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(k['cache_hit'] for k in history)
    assert len({k['hash'] for k in history}) < 40


@pytest.mark.parametrize(
    'algorithm', [lambda scan: run_algorithm(scan, FDK(fill=False)), lambda scan: complete_views(scan, None, 9)]
)
def test_scans_off_the_circle_and_invalid_pixels_are_refused(algorithm):
    geo = small(n=5)
    moved = Geometry.from_poses(
        geo.rays().moved(shift=np.array([0, 0, 1.0]) * np.arange(5)[:, None]),
        geo.nDetector,
        nVoxel=geo.grid.shape,
        dVoxel=geo.grid.spacing,
    )
    ones = np.ones((5, *geo.nDetector), np.float32)
    with pytest.raises(InputError, match='other poses'):
        algorithm(Scan(moved, ones))
    valid = ones > 0
    valid[0, 0, 0] = False
    with pytest.raises(InputError, match='not valid'):
        algorithm(Scan(geo, ones, valid))


def test_what_counts_as_matched_where_fdk_cannot_say(system):
    """Nothing does, so that the descent stays in bounds."""
    geo = small(n=5)
    moved = Geometry.from_poses(
        geo.rays().moved(shift=np.array([0, 0, 1.0]) * np.arange(5)[:, None]),
        geo.nDetector,
        nVoxel=geo.grid.shape,
        dVoxel=geo.grid.spacing,
    )
    scan = Scan(moved, np.ones((5, *geo.nDetector), np.float32))
    assert ASDPOCS()._maxl2err(System(scan), scan) == 0


@pytest.mark.parametrize('every, times', [(0, 0), (1, 7), (5, 2)])
def test_passes_between_corrections(system, monkeypatch, every, times):
    calls, correct = [], System.correct
    monkeypatch.setattr(System, 'correct', lambda self, x: calls.append(1) or correct(self, x))
    run_algorithm(system[0], ASDPOCS(niter=7, exact_every=every, alpha_red=1.0, tviter=1))
    assert len(calls) == times


def test_blocks_go_by_their_middle_view():
    """The middle views are at 10, 40 and 120 degrees; the first views would give another order."""
    actual = blocks(np.radians([0, 10, 170, 40, 60, 120]), 2, 'angularDistance', np.random.default_rng(0))
    assert [b.tolist() for b in actual] == [[0, 1], [4, 5], [2, 3]]
