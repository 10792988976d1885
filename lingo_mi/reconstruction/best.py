"""The best voxel volume of a scan: settings are chosen by measured views that are held out."""

from __future__ import annotations

import gc
import json
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lingo_mi.common.errors import InputError, require_type, shown
from lingo_mi.files.slabs import plan_and_error_map
from lingo_mi.files.units import unit_of
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.asd_pocs import ASDPOCS
from lingo_mi.reconstruction.held_out import NEAR, PATIENCE, Score, Trial, TrialWatch, split_views
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.penalised import MOST, TRIED, PenalisedLeastSquares
from lingo_mi.reconstruction.priors import Prior
from lingo_mi.reconstruction.refined import Refined, structure
from lingo_mi.reconstruction.sart import SART
from lingo_mi.reconstruction.voxel_values import means, values
from lingo_mi.reconstruction.wide_pixels import excess_width
from lingo_mi.scan import Scan, values_digest
from lingo_mi.storage.file_access import as_path, new_file, write_text, writing

START, TRIAL = 10, 4  # passes of ASD-POCS before the refinement, at most; passes after which grids are compared
LONG, SWEEPS = 50, 20  # passes of ASD-POCS and of SART, at most, if they are the result itself
AHEAD = 0.9  # times another score: below it a setting is clearly ahead, whatever passes the other one still gets
CLOSE = 0.95  # the same for smaller voxels, whose passes cost eight times as much
TESTED = 8  # passes of a refinement that are tried: if the last of them still gain, noise does not limit their number
MARGIN = 1.02  # how much better the scan's own voxels must be than smaller ones, see `Best`
PLAIN = 1.015  # how much better ASD-POCS and SART must be than a refinement, see `Best`
LITTLE = 0.95  # times the score after one pass of a refinement: if more passes gain less, noise limits them
LMBDA, LMBDA_RED = 1.8, 0.97  # of the refinement: long steps converge sooner, and shorten before they take up the noise
TVITER, ALPHA = 10, 0.24  # of the refinement: half as many steps as `Refined`, twice as long, are as good in less time
SMOOTH = 0.5  # alpha of the refinement with more total variation, for noisy scans
SPREAD = 1.0  # standard deviation of the neighbourhood of a voxel in `error_map`, voxels
DOUBTFUL = 0.5  # a score above it says that something is wrong; sound scans of 1000 photons a pixel or more reach 0.36
VOXELS = MEANS, VALUES, FINER = 'means', 'values', 'finer'
TICKS = 20  # steps of the progress for a fit

# Fits a cloud: called as fit(scan, progress), with progress(steps done, steps). Returns a function of a grid, which gives the
# cloud's densities per mm [x, y, z] at the voxel centres.
Fit = Callable[[Scan, Callable[[int, int], None]], Callable[[Grid], np.ndarray]]


@dataclass(frozen=True, eq=False)
class Chosen(Reconstruction):
    """A `Reconstruction` by `Best`, with the trials that led to it.

    Parameters
    ----------
    plan : tuple[Trial, ...]
        A `Trial` for each setting, in the order of the work.
    taken : int
        Index of the chosen trial.
    error : ndarray or None
        Map of errors, float32 [x, y, z], density per mm (`error_map`).
    meaning : str
        What each number is: 'means' over the voxels' cubes, or 'values' at their centres (`Best.voxels`).

    Examples
    --------
    >>> result = lm.reconstruct(scan, lm.Best())
    >>> print(result.report())
    """

    plan: tuple[Trial, ...] = ()
    taken: int = 0
    error: np.ndarray | None = None
    meaning: str = 'values'
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of the scan's own voxels, mm

    def report(self) -> str:
        """One line for each trial: setting, voxels, passes, and the error of the held-out views (`Score`)."""
        lines = []
        for i, trial in enumerate(self.plan):
            size = ' x '.join(f'{d / trial.finer:.4g}' for d in self.spacing)
            mark = '*' if i == self.taken else ' '
            how = (
                f'{trial.passes or trial.niter:2} passes' if trial.strength is None else f'strength {trial.strength:g}'
            )
            output = ''.join(f', {score:.5f} as {kind}' for kind, score in trial.outputs.items())
            lines.append(f'{mark} {trial.name:22} voxels {size} mm, {how}: {trial.score:.5f}{output}')
        return '\n'.join(lines)

    def record(self) -> dict[str, Any]:
        """The plan as plain values for a JSON file, with a checksum of its volume."""
        return dict(
            volume=values_digest(self.volume),
            score='|A x - b| / |b| of the held-out views, weighted by the root of the frequency, after every pass',
            taken=self.taken,
            meaning=self.meaning,
            tried=[trial.record for trial in self.plan],
            seconds=self.seconds,
        )

    def save(
        self, path: str | PathLike, *, units: str = '1/mm', mu_water: float | None = None, force: bool = False
    ) -> Path:
        """Write the volume (`Reconstruction.save`), and beside it the map of errors and the plan. Return the volume's path.

        For V.nii.gz these are V-error.nii.gz, always per mm, and V-plan.json.
        """
        path, unit = as_path('path', path), unit_of(units, mu_water)
        plan, error = plan_and_error_map(path)
        with writing(path):
            for file in (plan, error):
                new_file(file, force)
        super().save(path, units=units, mu_water=mu_water, force=force)
        assert self.error is not None
        Reconstruction(self.error, [], self.seconds, self.grid).save(error, force=force)
        as_read = dict(volume=values_digest(unit.densities(unit.values(self.volume))))
        write_text(plan, json.dumps(self.record() | as_read, indent=1) + '\n')  # last: it says whose the map is
        return path


@dataclass(frozen=True)
class Best(Algorithm):
    """ASD-POCS, its refinements and priors, chosen by held-out views. It needs neither a cloud nor the truth.

    1. One view in `held_out` is held out. `ASDPOCS` reconstructs from the others. After every pass, the volume's projections are
       compared with the held-out views (`held_out.Score`). The passes end when they no longer predict these views better.
    2. Over-relaxed steps of `Refined` follow (changes weighted by `structure`, corrections for the error of Joseph's projector),
       on the scan's voxels and on `finer` times smaller ones. If passes after the first one gain little, noise limits them, and
       `Best` tries more total variation.
    3. With `prior`, it tries `PenalisedLeastSquares`, and the held-out views choose the strength. With `cloud`, it fits a cloud
       of Gaussians to the views that are not held out, and tries the best of these refinements from the cloud's volume.
    4. `ASDPOCS` and `SART` get all their passes, unless a refinement is already far ahead of `ASDPOCS`.
    5. The setting that predicts the held-out views best, with its number of passes, is applied to all views.

    Smaller voxels suit objects with detail finer than the scan's voxels, which turn it into streaks. Streaks lie along
    the views of the reconstruction, and held-out views hardly show them. The scan's own voxels must therefore be 2 % better.
    `SART` and `ASDPOCS`, which leave more streaks and noise than a refinement, must be 1.5 % better, unless `voxels` is 'values',
    whose purpose is to predict views.

    Parameters
    ----------
    niter : int
        Largest number of passes of a refinement, at least 1.
    finer : int
        Parts along each side of a smaller voxel, at least 1. 1 tries only the scan's voxels. Memory grows with the cube.
    held_out : int
        One view in every `held_out` is held out. It is at least 2.
    cloud : bool
        Whether to try the volume of a fitted cloud as a start, which takes two fits.
    seed : int
        Seed of the random orders, at least 0.
    voxels : {'means', 'values', 'finer'}
        What a number means if smaller voxels win. 'means': the mean over the voxel's cube, to view, measure and compare.
        'values': the value at its centre, between which projectors interpolate linearly (`voxel_values.values`). 'finer': the
        smaller voxels themselves. If the scan's own voxels win, numbers are values at the centres. The held-out views judge
        'values' and 'finer' as they are returned, but 'means' by the smaller voxels, because projectors blur even true means.
    prior : Prior, optional
        A prior to try beside the other settings.

    Raises
    ------
    InputError
        For an option out of its range, and for a scan of fewer than four views.

    References
    ----------
    Held-out views choose between regularisations as in cross-validation: Golub, Heath and Wahba, "Generalized cross-validation as
    a method for choosing a good ridge parameter", Technometrics 21 (1979).

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> measured = x3d_scan.scan(make('foot', 24), views=10, pixels=48).train
    >>> result = lm.reconstruct(measured, lm.Best(niter=5), progress=False)
    >>> len(result.plan) >= 3, result.error.shape
    (True, (24, 24, 24))
    """

    name: ClassVar[str] = 'best'
    no_start: ClassVar[str] = (
        'best starts from nothing, since a volume has seen the views that it holds out: leave out start'
    )

    niter: int = 20
    finer: int = 2
    held_out: int = 5
    cloud: bool = False
    seed: int = 0
    voxels: str = 'means'
    prior: Prior | None = None

    def __post_init__(self):
        check_counts(niter=self.niter, finer=self.finer)
        check_counts(least=2, held_out=self.held_out)
        check_counts(least=0, seed=self.seed)
        if self.voxels not in VOXELS:
            raise InputError(f'voxels must be one of {", ".join(VOXELS)}, not {shown(self.voxels)}')
        if self.prior is not None:
            require_type('prior', self.prior, Prior, 'such as lm.TV()')

    def steps(self, scan: Scan) -> int:
        more = (2 * TICKS + TESTED if self.cloud else 0) + (TRIED * MOST if self.prior else 0)
        return 2 * START + TRIAL + 2 * TESTED + 3 * self.niter + more + LONG + SWEEPS

    def grid(self, geometry: Geometry) -> Grid:
        return geometry.grid.finer(self.finer)

    @property
    def volumes(self) -> float:
        return 0.0 if self.prior is None else self._penalised(None).volumes / self.finer**3

    def _run(
        self, scan: Scan, *, start: ArrayLike | None = None, progress: Progress | None = None, fit: Fit | None = None
    ) -> Chosen:
        """Reconstruct the volume of a scan, see `run_algorithm`. The residuals belong to the last refinement.

        Parameters
        ----------
        fit : Fit or None
            With `cloud`: fits one (`completion.prepare.fit_cloud`).

        Raises
        ------
        InputError
            If `cloud` is set and `fit` is missing.
        """
        if self.cloud and fit is None:
            raise InputError('best needs a function that fits a cloud: use lm.reconstruct')
        began, count = time.perf_counter(), self._counter(progress, self.steps(scan))
        train, held_out = split_views(scan, self.held_out)
        plan = self._plan(train, held_out, count, fit if self.cloud else None)
        gc.collect()
        dr.flush_malloc_cache()  # two thirds of the memory that the trials took
        chosen = self._judged(plan, train, held_out, count)
        if chosen.score > DOUBTFUL:
            warnings.warn(
                f'views that are held out are predicted badly (error {chosen.score:.2g}; 0 is exact, 1 an empty volume): unless '
                'they are few or very noisy, check geometry, angles and order of the views',
                stacklevel=3,
            )
        result = self._apply(scan, chosen, count, fit)
        assert chosen.volume is not None  # of its best pass
        tried, volume = (_output(v, chosen.finer, self.voxels) for v in (chosen.volume, result.volume))
        if progress is not None:
            progress(self.steps(scan), self.steps(scan), result.residuals[-1])
        for trial in plan:
            trial.volume = None
        grid = scan.geometry.grid
        return Chosen(
            volume,
            result.residuals,
            time.perf_counter() - began,
            grid.finer(chosen.finer) if self.voxels == FINER else grid,
            tuple(plan),
            next(i for i, trial in enumerate(plan) if trial is chosen),
            error_map(volume, tried),
            MEANS if self.voxels == MEANS and chosen.finer > 1 else VALUES,
            grid.spacing,
        )

    def _judged(self, plan: list[Trial], train: Scan, held_out: Scan, count) -> Trial:
        """The trial to apply. ASD-POCS and SART get all their passes, unless a refinement is far ahead of ASD-POCS. If one of
        them is ahead then, the refinement gets all its passes, too.
        """

        def error(trial: Trial) -> float:
            return trial.outputs.get(VALUES, trial.score) if self.voxels == VALUES else trial.score

        def best(trials: list[Trial]) -> Trial:
            return min(trials, key=error) if self.voxels == VALUES else _best(trials)

        margin = 1 if self.voxels == VALUES else PLAIN

        def choice(refined: Trial) -> Trial:
            plain = min(plan[:2], key=error)
            return refined if error(refined) < margin * error(plain) else plain

        refined = best([trial for trial in plan[1:] if trial.volume is not None])
        if error(refined) < AHEAD * plan[0].score:
            return refined
        if len(plan[0].scores) == START:  # it could go on
            plan[0] = _alone(ASDPOCS(niter=LONG, seed=self.seed), train, held_out, count)
        plan.insert(1, _alone(SART(niter=SWEEPS, seed=self.seed), train, held_out, count))
        chosen = choice(refined)
        if chosen is refined or refined.passes <= TESTED or refined.cloud:
            return chosen
        again = self._try(train, held_out, plan[0], _refined(refined.finer, refined.smooth), count, self.niter)
        plan.append(again)
        return choice(again)

    def _plan(self, train: Scan, held_out: Scan, count, fit: Fit | None) -> list[Trial]:
        plain = _alone(ASDPOCS(niter=START, seed=self.seed), train, held_out, count)
        plan = [plain]
        scan_voxels = self._try(train, held_out, plain, _refined(1), count, TRIAL)
        plan.append(scan_voxels)
        gains = scan_voxels.niter == TRIAL < self.niter
        if self.finer > 1:
            beat = (AHEAD if gains else NEAR) * scan_voxels.score
            plan.append(self._try(train, held_out, plain, _refined(self.finer), count, beat=beat))
        ahead = any(min(trial.scores[:TRIAL]) < AHEAD * scan_voxels.score for trial in plan[2:])
        if gains and not ahead:  # both were cut short, and may gain from a longer start
            plan[0] = _alone(ASDPOCS(niter=LONG, seed=self.seed), train, held_out, count)
            plan[1] = self._try(train, held_out, plan[0], _refined(1), count)
            if self.finer > 1:
                beat = NEAR * min(plan[1].scores[:TRIAL])
                plan[2] = self._try(train, held_out, plan[0], _refined(self.finer), count, beat=beat)
        # After few passes, the one that is behind may still overtake.
        for _ in range(2 * len(plan[2:])):
            best = _best(plan[1:])
            i = 2 if best is plan[1] else 1
            if not _may_overtake(plan[i], best):
                break
            plan[i] = self._try(train, held_out, plan[0], _refined(plan[i].finer), count, self.niter)
        best = _best(plan[1:])
        if best.score > LITTLE * best.scores[0]:
            smooth = _refined(best.finer, smooth=True)
            # Its long steps start badly, so that a few passes do not show how good it gets.
            plan.append(self._try(train, held_out, plan[0], smooth, count, self.niter))
            best = _best(plan[1:])
        if self.prior is not None:
            strength, volume, scores, _ = self._penalised(None).search(train, held_out, None, count, TRIED * MOST)
            plan.append(Trial(f'pls, {type(self.prior).__name__}', 1, scores=scores, volume=volume, strength=strength))
        if fit is not None:
            for trial in plan[1:]:
                if trial is not best and trial.strength is None:
                    trial.volume = None  # room for the fit
            cloud = Trial('cloud', best.finer, volume=self._cloud(train, best.finer, fit, count))
            plan.append(self._try(train, held_out, cloud, _refined(best.finer, best.smooth, cloud=True), count))
        return plan

    def _penalised(self, strength: float | None) -> PenalisedLeastSquares:
        assert self.prior is not None
        return PenalisedLeastSquares(self.prior, strength)

    def _cloud(self, scan: Scan, finer: int, fit: Fit, count) -> np.ndarray:
        """The volume of a cloud that is fitted to a scan."""

        def progress(done: int, steps: int) -> None:
            if count is not None and done * TICKS // steps > (done - 1) * TICKS // steps:
                count(done, steps, None)

        return fit(scan, progress)(scan.geometry.grid.finer(finer))

    def _try(self, train, held_out, start: Trial, trial: Trial, count, niter=TESTED, beat=None) -> Trial:
        """Refine the volume of another trial, by `niter` passes at most. beat: as for `TrialWatch`."""
        assert start.volume is not None  # of its best pass
        trial.before = start.niter if start.name == ASDPOCS.name else 0
        score = Score(held_out.on(held_out.geometry.grid.finer(trial.finer)))
        niter, watch = min(niter, self.niter), TrialWatch(score, trial, beat, TRIAL)
        refine(train, start.volume, niter, trial.finer, trial.smooth, self.seed, count, watch)
        if len(trial.scores) == TESTED < trial.niter + PATIENCE:
            trial.passes = self.niter
        if trial.finer > 1:
            score, volume = Score(held_out), trial.volume
            assert volume is not None
            trial.outputs = {kind: score(uploaded(_output(volume, trial.finer, kind))) for kind in (MEANS, VALUES)}
        return trial

    def _apply(self, scan: Scan, trial: Trial, count, fit: Fit | None) -> Reconstruction:
        """The chosen setting on all views, from the start: passes from the trial's volume save time, but lost up to 1.5 dB."""
        if trial.name == SART.name:
            return SART(niter=trial.niter, seed=self.seed)._run(scan, progress=count)
        if trial.strength is not None:
            return self._penalised(trial.strength)._run(scan, start=trial.volume, progress=count)
        if trial.cloud:
            assert fit is not None  # which has made the trial
            start = self._cloud(scan, trial.finer, fit, count)
        else:
            plain = ASDPOCS(niter=trial.before or trial.niter, seed=self.seed)._run(scan, progress=count)
            if trial.name == ASDPOCS.name:
                return plain
            start = plain.volume
        return refine(scan, start, trial.passes or trial.niter, trial.finer, trial.smooth, self.seed, count)

    @staticmethod
    def _counter(progress: Progress | None, steps: int):
        """A `progress` for one stage after another, which counts on; trials may end early, so it may jump at the end."""
        if progress is None:
            return None
        done = iter(range(1, steps))

        def count(_, __, residual):
            progress(next(done, steps - 1), steps, residual)

        return count


def refine(
    scan: Scan,
    start: np.ndarray,
    niter: int,
    finer: int = 1,
    smooth: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
    watch: TrialWatch | None = None,
) -> Reconstruction:
    """The passes of `Refined` over measured views.

    Parameters
    ----------
    start : ndarray
        Volume [x, y, z], on the scan's own voxels or on the smaller ones.
    finer : int
        Parts along each side of a voxel; the volume that is returned has the smaller voxels.
    smooth : bool
        Whether to take more total variation.
    """
    fine = scan.on(scan.geometry.grid.finer(finer))
    if start.shape == scan.geometry.grid.shape:
        start = _parts(start, finer)
    how = Refined(niter=niter, seed=seed)
    how = replace(how, alpha=SMOOTH) if smooth else replace(how, tviter=TVITER, alpha=ALPHA)
    algorithm = replace(how.on_measured(), lmbda=LMBDA, lmbda_red=LMBDA_RED)
    weights, blur = structure(start), excess_width(fine.geometry)
    return algorithm._run(fine, start=start, weights=weights, blur=blur, progress=progress, watch=watch)


def _refined(finer: int, smooth: bool = False, cloud: bool = False) -> Trial:
    return Trial('refined' + ', smooth' * smooth + ', cloud' * cloud, finer, smooth, cloud)


def _best(trials: Sequence[Trial]) -> Trial:
    """The one with the lowest score; the scan's own voxels must be better than smaller ones by `MARGIN`."""
    return min(trials, key=lambda trial: trial.score * (MARGIN if trial.finer == 1 else 1))


def _may_overtake(trial: Trial, best: Trial) -> bool:
    """Whether a trial that was cut short still gained, and is near the best one."""
    return len(trial.scores) < trial.passes and best.score > (AHEAD if trial.finer == 1 else CLOSE) * trial.score


def _alone(algorithm: ASDPOCS | SART, train: Scan, held_out: Scan, count) -> Trial:
    """Try an algorithm from an empty volume on the scan's voxels."""
    trial = Trial(algorithm.name, 1)
    algorithm._run(train, progress=count, watch=TrialWatch(Score(held_out), trial, slow=True))
    return trial


def error_map(volume: np.ndarray, fewer: np.ndarray) -> np.ndarray:
    """Return a map of the uncertainty of a volume: its difference from a volume of fewer views, root mean square around each
    voxel.

    Both volumes and the result are float32 [x, y, z], density per mm. The map ranks the voxels. It does not tell the size of the
    error, because both volumes lack what no view shows.
    """
    square = ndimage.gaussian_filter((volume - fewer) ** 2, SPREAD)
    return np.sqrt(np.maximum(square, 0))


def _output(volume: np.ndarray, finer: int, voxels: str) -> np.ndarray:
    """The numbers that are returned for a volume (`Best.voxels`)."""
    if finer == 1 or voxels == FINER:
        return volume
    return means(volume, finer) if voxels == MEANS else values(means(volume, finer))


def _parts(volume: np.ndarray, finer: int) -> np.ndarray:
    """A volume on `finer` times smaller voxels, interpolated linearly."""
    return volume if finer == 1 else np.asarray(ndimage.zoom(volume, finer, order=1, mode='nearest', grid_mode=True))
