"""The choice of settings by held-out views: what is held out, the score, and that each kind of scan gets what suits it."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

import lingo_mi as lm
from helpers.grids import scan as small
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import psnr_3d
from lingo_mi.phantoms import make
from lingo_mi.projectors.grid import project_volume
from lingo_mi.reconstruction import ASDPOCS, FDK, SART, Best, Reconstruction, run
from lingo_mi.reconstruction.best import Trial, _best, error_map
from lingo_mi.reconstruction.held_out import Score, TrialWatch, split_views
from lingo_mi.reconstruction.run import check_room, run_algorithm
from lingo_mi.reconstruction.system import System
from lingo_mi.reconstruction.voxel_values import cube_means, means, values
from lingo_mi.scan import Scan


def scanner(size, spacing):
    return CircularGeometry(
        DSO=1000.0, DSD=1500.0, nDetector=(40, 40), dDetector=4.0, angles=circular(20), grid=Grid(size, spacing)
    )


def scanned(parts, photons=0.0):
    """A scan on 24^3 voxels of the phantom foot on `parts` times as many, and the truth on the voxels."""
    n = 24 * parts
    fine = make('foot', n).data * np.float32(0.08)
    views = project_volume(fine, scanner((n,) * 3, 3 / parts))
    if photons:
        counts = np.random.default_rng(0).poisson(photons * np.exp(-views.astype(float)))
        views = -np.log(np.maximum(counts, 0.5) / photons).astype(np.float32)
    truth = fine.reshape(24, parts, 24, parts, 24, parts).mean((1, 3, 5))
    return Scan(scanner((24,) * 3, 3.0), views), truth


@pytest.mark.parametrize('views, held', [(4, [1]), (5, [2]), (10, [2, 7]), (25, [2, 7, 12, 17, 22])])
def test_which_views_are_held_out(views, held):
    geometry = small(n=views)
    scan = Scan(geometry, np.arange(views)[:, None, None] + np.zeros((views, *geometry.nDetector)))
    fitted, out = split_views(scan, 5)
    assert out.projections[:, 0, 0].tolist() == held
    assert sorted([*fitted.projections[:, 0, 0], *held]) == list(range(views))


def test_too_few_views():
    geometry = small(n=3)
    with pytest.raises(InputError, match='needs at least 4, but the scan has 3'):
        run_algorithm(Scan(geometry, np.ones((3, *geometry.nDetector))), Best())


def test_no_start():
    geometry = small(n=5)
    with pytest.raises(InputError, match='best starts from nothing'):
        run_algorithm(Scan(geometry, np.ones((5, *geometry.nDetector))), Best(), start=np.ones(geometry.grid.shape))


def test_the_score_is_the_error_of_the_volume_smooth_or_not():
    """Errors of a tenth of the truth's norm are smooth, or independent from voxel to voxel. Plain residuals hide the latter,
    which cancel along the rays. Trilinear interpolation takes a third to a half off such an error."""
    scan, truth = scanned(1)
    rng = np.random.default_rng(1)
    x, y, _ = np.indices(truth.shape) - 11.5
    measure, system, scores, plain = Score(scan), System(scan), [], []
    for smooth in (4, 2, 1, 0):
        error = gaussian_filter(rng.normal(size=truth.shape), smooth, mode='constant') * (np.hypot(x, y) < 10)
        volume = system.start(truth + error * (0.1 * np.linalg.norm(truth) / np.linalg.norm(error)))
        scores.append(measure(volume))
        plain.append(system.residual(volume)[1])
    assert 0.08 < min(scores[:3]) and max(scores) < 0.12 and 0.05 < scores[3] < 0.067
    assert plain[0] > 4 * plain[-1]
    assert measure(system.start(truth)) < 1e-4  # float32


@pytest.mark.thorough
def test_finer_voxels_for_finer_objects_only():
    for parts in (1, 2):
        scan, truth = scanned(parts)
        result = run_algorithm(scan, Best(niter=8))
        assert result.plan[result.taken].finer == parts
        assert result.volume.shape == truth.shape
        assert psnr_3d(result.volume, truth) > psnr_3d(run_algorithm(scan, ASDPOCS(niter=20)).volume, truth) + 1


@pytest.mark.parametrize('score, taken', [(1.01, 2), (1.03, 1)])
def test_smaller_voxels_where_the_scores_are_nearly_the_same(score, taken):
    assert _best([Trial('refined', 1, scores=[1.0]), Trial('refined', 2, scores=[score])]).finer == taken


@pytest.mark.parametrize('right', [True, False])
def test_a_cloud_is_taken_where_it_predicts_the_views_better(right):
    scan, truth = scanned(1)
    fitted, done = [], []

    def fit(part, progress):
        fitted.append(len(part))
        for k in range(1, 101):
            progress(k, 100)
        return lambda geometry: truth if right else np.full_like(truth, truth.mean())

    result = run_algorithm(scan, Best(niter=2, finer=1, cloud=True), fit=fit, progress=lambda k, *_: done.append(k))
    assert result.plan[-1].cloud and result.plan[result.taken].cloud == right
    assert fitted == [16, 20][: 1 + right]  # the views that are kept; all of them, where it is taken
    assert done[:-1] == list(range(1, len(done)))


@pytest.mark.parametrize('slow, passes', [(False, 50), (True, 5)])
def test_a_slow_trial_ends_where_passes_gain_little(slow, passes):
    falling = iter([0.5, 0.4, *(0.4 - 1e-4 * k for k in range(1, 60))])

    class Falling:
        size = 1, 1, 1

        def __call__(self, x):
            return next(falling)

    watch = TrialWatch(Falling(), Trial('asd-pocs', 1), slow=slow)
    assert next(k for k in range(1, 51) if watch(k, mi.Float(0)) or k == 50) == passes


def test_a_cloud_needs_a_fit():
    with pytest.raises(InputError, match='use lm.reconstruct'):
        run_algorithm(scanned(1)[0], Best(cloud=True))


@pytest.mark.thorough
def test_the_cloud_is_fitted():
    scan, truth = scanned(2)
    result = lm.reconstruct(scan, Best(niter=3, cloud=True), progress=False)
    assert result.plan[-1].cloud and result.plan[-1].score < result.plan[0].score
    assert psnr_3d(result.volume, truth) > 30


@pytest.mark.thorough
def test_noise_stops_it_early():
    clean, noisy = (run_algorithm(scanned(1, photons)[0], Best(niter=8)) for photons in (0, 300.0))
    assert noisy.plan[0].niter < clean.plan[0].niter
    assert [any(trial.smooth for trial in result.plan) for result in (clean, noisy)] == [False, True]
    scan, truth = scanned(1, 300.0)
    assert psnr_3d(noisy.volume, truth) > psnr_3d(run_algorithm(scan, ASDPOCS(niter=20)).volume, truth) + 1


def test_with_noise_a_cloud_gets_more_total_variation_too():
    scan, truth = scanned(1, 100.0)
    result = run_algorithm(
        scan, Best(niter=8, finer=1, cloud=True), fit=lambda part, progress: lambda geometry: 0.9 * truth
    )
    refined = [trial for trial in result.plan[:-1] if trial.name.startswith('refined')]
    best = min(refined, key=lambda trial: trial.score)
    assert best.smooth and result.plan[-1].smooth and result.plan[-1].name == 'refined, smooth, cloud'


@pytest.mark.thorough
def test_the_plan_is_told_and_can_be_kept():
    scan, _ = scanned(1)
    result = run_algorithm(scan, Best(niter=2, finer=1))
    record, lines = result.record(), result.report().splitlines()
    assert [line[0] for line in lines].index('*') == result.taken == record['taken']
    assert len(lines) == len(record['tried']) == len(result.plan)
    for tried in record['tried']:
        assert tried['scores'][tried['niter'] - 1] == tried['score'] == min(tried['scores'])
    again = run_algorithm(replace(scan), Best(niter=2, finer=1))
    np.testing.assert_array_equal(again.volume, result.volume)
    np.testing.assert_array_equal(again.error, result.error)


def test_progress_goes_on_to_the_last_step_but_one():
    """The progress waits there if the trials take more steps than were foreseen."""
    calls = []
    count = Best._counter(lambda done, total, residual: calls.append((done, total)), 4)
    for _ in range(5):
        count(1, 1, 0.5)
    assert calls == [(1, 4), (2, 4), (3, 4), (3, 4), (3, 4)]


def test_the_map_of_errors():
    volume = np.zeros((9, 9, 9), np.float32)
    other = volume.copy()
    other[4, 4, 4] = 1
    actual = error_map(volume, other)
    assert actual.dtype == np.float32 and actual.argmax() == np.ravel_multi_index((4, 4, 4), actual.shape)
    assert abs((actual**2).sum() - 1) < 1e-3 and not error_map(volume, volume).any()


@pytest.fixture(scope='module')
def finer_scan():
    """A foot of finer detail than its voxels, views between those that are reconstructed from, and the truth."""
    scan, truth = scanned(2)
    return scan.subset(np.arange(0, 20, 2)), scan.subset(np.arange(1, 20, 2)), truth


@pytest.mark.thorough
def test_values_predict_views_and_means_the_truth(finer_scan):
    """No numbers are good at both: see docs/how_to/best.md."""
    scan, rest, truth = finer_scan
    results = {kind: run_algorithm(scan, Best(niter=4, voxels=kind)) for kind in ('means', 'values', 'finer')}
    pocs = run_algorithm(scan, ASDPOCS(niter=50)).volume

    def missed(volume, grid):
        return np.sqrt(np.mean((project_volume(volume, rest.geometry.on(grid)) - rest.projections) ** 2))

    wrong = {kind: missed(one.volume, one.grid) for kind, one in results.items()}
    assert results['means'].meaning == 'means' and results['values'].meaning == 'values'
    assert results['finer'].grid == scan.geometry.grid.finer(2) and results['finer'].error.shape == (48, 48, 48)
    assert wrong['finer'] < wrong['values'] < min(wrong['means'], missed(pocs, scan.geometry.grid))
    assert psnr_3d(results['means'].volume, truth) > psnr_3d(results['values'].volume, truth)
    on_scan = scan.geometry.grid
    assert missed(values(truth), on_scan) < missed(truth, on_scan)  # so the projections of means do not judge them
    finer = [trial for trial in results['means'].plan if trial.finer == 2]
    assert all(trial.outputs['values'] < trial.outputs['means'] for trial in finer)
    assert f'{finer[0].outputs["means"]:.5f} as means' in results['means'].report()
    np.testing.assert_allclose(means(results['finer'].volume, 2), results['means'].volume, rtol=1e-5, atol=1e-7)


def test_means_over_the_cubes_of_an_interpolation():
    """The reference is trilinear interpolation at many points, far from the border; `values` undoes most of it."""
    volume = gaussian_filter(np.random.default_rng(0).normal(size=(9, 9, 9)), 1.0)
    points = (np.arange(20) + 0.5) / 20 - 0.5
    around = np.stack(np.meshgrid(*[4 + points] * 3, indexing='ij'))
    expected = map_coordinates(volume, around.reshape(3, -1), order=1).mean()
    assert cube_means(volume)[4, 4, 4] == pytest.approx(expected, rel=1e-3)
    mean = cube_means(volume)
    left = np.linalg.norm((values(mean) - volume)[2:-2, 2:-2, 2:-2])
    assert left < 0.25 * np.linalg.norm((mean - volume)[2:-2, 2:-2, 2:-2])


@pytest.mark.parametrize(
    'best, score, voxels, winner',
    [
        ('asd-pocs', 0.5, 'means', 'asd-pocs'),
        ('sart', 0.5, 'means', 'sart'),
        ('sart', 0.98, 'means', 'refined'),  # streaks and noise that held-out views hardly show
        ('sart', 0.98, 'values', 'sart'),  # whose purpose is to predict views
    ],
)
def test_asd_pocs_and_sart_are_candidates_to_the_end(monkeypatch, best, score, voxels, winner):
    """A refinement that is a little ahead of ten passes of ASD-POCS does not win before both have had all their passes."""

    def plan(self, train, held_out, count, fit):
        near = Trial('refined', 1, scores=[0.99], volume=np.zeros(train.geometry.grid.shape, np.float32))
        return [Trial('asd-pocs', 1, scores=[1.0] * 10), near]

    def passes(algorithm, scan, *, progress=None, watch=None):
        if watch is not None:
            watch.trial.scores.append(score if algorithm.name == best else score + 0.1)
            watch.trial.volume = np.zeros(scan.geometry.grid.shape, np.float32)
        return Reconstruction(np.full(scan.geometry.grid.shape, algorithm.niter, np.float32), [0.1], 0.0, None)

    monkeypatch.setattr(Best, '_plan', plan)
    for algorithm in (ASDPOCS, SART):
        monkeypatch.setattr(algorithm, '_run', passes)
    monkeypatch.setattr('lingo_mi.reconstruction.best.refine', lambda scan, start, *args: passes(SART(niter=1), scan))
    result = run_algorithm(scanned(1)[0], Best(voxels=voxels))
    assert [trial.name for trial in result.plan] == ['asd-pocs', 'sart', 'refined']
    assert result.plan[result.taken].name == winner and (result.volume == 1).all()  # its best pass


@pytest.mark.parametrize(
    'own, finer, passes',
    [
        ([0.60, 0.51, 0.40], [0.50, 0.49], [20, 8]),  # the scan's own voxels overtake
        ([0.60, 0.51, 0.48], [0.50, 0.49, 0.30], [20, 20]),  # and the smaller ones, which still gain, get theirs
        ([0.60, 0.51, 0.505], [0.50, 0.49, 0.30], [20, 8]),  # they do not
        ([0.60, 0.56, 0.40], [0.50, 0.49], [8, 8]),  # they are too far behind
        ([0.50, 0.45], [0.60, 0.46, 0.30], [8, 20]),  # the smaller ones overtake
        ([0.50, 0.45, 0.44], [0.60, 0.46, 0.43], [20, 20]),  # and the scan's own, which still gain, get theirs
        ([0.50, 0.45], [0.60, 0.48, 0.30], [8, 8]),  # the smaller ones, which cost more, are too far behind
    ],
)
def test_who_is_a_little_behind_and_still_gains_gets_all_passes(monkeypatch, own, finer, passes):
    """Scores are after one pass, after 8, and after 20; two of them: the last passes gain nothing."""

    def tried(self, train, held_out, start, trial, count, niter=8, beat=None):
        first, eighth, *last = own if trial.finer == 1 else finer
        trial.scores, trial.passes = [first] * 7 + [eighth], 20 if last else 8
        if niter == 20:
            trial.scores += [*([eighth] * 11), *(last or [eighth])]
        return trial

    monkeypatch.setattr(Best, '_try', tried)
    monkeypatch.setattr(
        'lingo_mi.reconstruction.best._alone', lambda *args: Trial('asd-pocs', 1, scores=[1.0], volume=np.zeros(1))
    )
    scan, _ = scanned(1)
    plan = Best()._plan(scan, scan, None, None)
    assert [len(trial.scores) for trial in plan[1:3]] == passes


def test_both_sizes_of_voxels_start_alike(monkeypatch):
    """More passes of ASD-POCS before one of them would decide between them."""
    starts = {1: [], 2: []}

    def tried(self, train, held_out, start, trial, count, niter=8, beat=None):
        starts[trial.finer].append(start)
        trial.scores = [1 - 0.01 * k for k in range(niter)]
        return trial

    monkeypatch.setattr(Best, '_try', tried)
    monkeypatch.setattr('lingo_mi.reconstruction.best._alone', lambda algorithm, *_: Trial(algorithm.name, 1))
    plan = Best()._plan(None, None, None, None)
    assert len(starts[2]) == 2 and starts[1][-1] is starts[2][-1] is plan[0]


def test_a_prior_is_a_candidate():
    scan, _ = scanned(1, 300.0)
    result = run_algorithm(scan, Best(niter=2, finer=1, prior=lm.TV()))
    trial = result.plan[-1]
    assert trial.name == 'pls, TV' and 0 < trial.strength <= 1e-2 and 'strength' in result.report()
    assert result.taken == len(result.plan) - 1  # noise, and an object of uniform parts


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda: Best(voxels='half'), "voxels must be one of means, values, finer, not 'half'"),
        (lambda: Best(prior='tv'), 'prior must be a Prior'),
    ],
)
def test_bad_options(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize('sizes, what', [(dict(nVoxel=1700), 'voxels'), (dict(nDetector=2048), 'pixels in all views')])
def test_more_than_an_array_can_hold(monkeypatch, sizes, what):
    geometry = lm.Geometry.cone(
        **dict(DSO=500, DSD=750, nDetector=8, dDetector=1, nVoxel=8, dVoxel=1, angles=np.linspace(0, 6, 1100)) | sizes
    )
    with pytest.raises(InputError, match=f'{what} are more than an array can hold'):
        check_room(geometry, SART(1))
    if what != 'voxels':
        monkeypatch.setattr(run, 'check_memory', lambda *_, **__: None)
        check_room(geometry, FDK())


def test_views_in_a_wrong_order_are_warned_of():
    scan, _ = scanned(1)
    with pytest.warns(UserWarning, match='held out are predicted badly'):
        run_algorithm(
            replace(scan, projections=scan.projections[np.random.default_rng(0).permutation(20)]), Best(niter=2)
        )
