"""Measured views that are held out of a reconstruction, and how well it predicts them.

Errors of a volume and of its projections are not alike: noise in the voxels, which a reconstruction takes over from noisy views,
cancels along a ray. By the Fourier slice theorem the squared norm of a slice is the norm of its parallel views P, weighted by
the frequency w along the detector's rows,

    integral of f^2  ~  integral over the angles and w of |w| |P(angle, w)|^2

(Natterer, "The Mathematics of Computerized Tomography", 1986, theorem II.1.1 and section II.5). So the squared difference between
predicted and measured views is weighted by |w|; a fan or a cone is nearly parallel for this purpose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.reconstruction.system import evaluated
from lingo_mi.scan import Scan

LEAST_VIEWS = 4
NEAR = 1.03  # times another trial's score, which may still be beaten in the passes that follow
PATIENCE = 3  # passes without a better score, after which a trial ends
GAIN = 0.005  # part by which they must lower the score of a `slow` trial: with noise it sinks on while the volume gets worse


def split_views(scan: Scan, every: int) -> tuple[Scan, Scan]:
    """The views to reconstruct from, and those held out: one of `every` consecutive ones, never the first or the last. Views
    without a valid pixel are left out.

    Raises
    ------
    InputError
        For fewer than four views.

    Examples
    --------
    >>> kept, held_out = split_views(scan, 5)
    """
    if scan.valid is not None:
        scan = scan.subset(np.flatnonzero(scan.valid.any((1, 2))))
    if len(scan) < LEAST_VIEWS:
        raise InputError(
            f'choosing settings by held-out views needs at least {LEAST_VIEWS}, but the scan has {len(scan)}: '
            'take another algorithm, or give the settings'
        )
    held = held_out_views(len(scan), every)
    return scan.subset(np.setdiff1d(np.arange(len(scan)), held)), scan.subset(held)


def held_out_views(count: int, every: int) -> np.ndarray:
    """Return the indices of the views that are held out of `count` views, at least four."""
    every = min(every, count - 1)
    return np.arange(every // 2, count - 1, every)


@dataclass
class Trial:
    """One setting, tried on the views that are kept.

    Parameters
    ----------
    name : str
        Name of the setting.
    finer : int
        Parts along each side of a voxel.
    smooth : bool
        Whether with more total variation.
    cloud : bool
        Whether from the volume of a cloud.
    scores : list[float]
        `Score` of the held-out views after every pass; of a prior, of every strength.
    volume : ndarray or None
        After the pass with the lowest score, on the setting's own voxels.
    outputs : dict[str, float]
        `Score` of the numbers that would be returned for smaller voxels: of their 'means' and 'values' (`Best.voxels`).
    strength : float or None
        Strength of a prior, else None.
    before : int
        Passes of ASD-POCS that it starts from.
    passes : int
        Passes over all views if it is chosen: more than `niter` if its last passes still gained. 0: `niter`.
    """

    name: str
    finer: int
    smooth: bool = False
    cloud: bool = False
    scores: list[float] = field(default_factory=list)
    volume: np.ndarray | None = None
    outputs: dict[str, float] = field(default_factory=dict)
    strength: float | None = None
    before: int = 0
    passes: int = 0

    @property
    def niter(self) -> int:
        """The pass with the lowest score, from 1 on."""
        return int(np.argmin(self.scores)) + 1

    @property
    def score(self) -> float:
        return min(self.scores)

    @property
    def record(self) -> dict[str, Any]:
        """Everything but the volume, for a file."""
        return dict(
            setting=self.name,
            finer=self.finer,
            niter=self.niter,
            score=self.score,
            scores=self.scores,
            outputs=self.outputs,
            strength=self.strength,
            before=self.before,
            passes=self.passes or self.niter,
        )


def power(rows: np.ndarray) -> np.ndarray:
    """|spectrum|^2 |w| of rows of a detector [..., u], float64 [..., frequency]."""
    spectrum = np.fft.rfft(rows, 2 * rows.shape[-1])  # padded, since a row ends and does not repeat
    frequency = np.maximum(np.arange(spectrum.shape[-1]), 0.25)  # the mean of |w| in the bin about 0
    return np.abs(spectrum) ** 2 * frequency


class Score:
    """|A x - b| / |b| of held-out views, both weighted by the square root of the frequency along the rows.

    The line integrals A x are exact. Joseph's projector would favour small voxels, on which its error is smaller.

    Parameters
    ----------
    scan : Scan
        The views, and the voxels of the volumes.

    Examples
    --------
    >>> Score(held_out)(x)  # of a volume on the device, mi.Float [voxels]
    """

    def __init__(self, scan: Scan):
        self.A, self.views = GridPair(scan.geometry, scan.valid), np.arange(len(scan))
        self.size = scan.geometry.grid.shape
        self.b = self.A.images(scan.projections)
        rows, columns = scan.geometry.nDetector
        self.shape = len(scan), columns, rows
        self.all = self._norm(self.b) or 1.0

    def __call__(self, x: mi.Float) -> float:
        return self._norm(evaluated(self.b - self.A.forward(x, self.views)[0])) / self.all

    def _norm(self, images: mi.Float) -> float:
        views = images.numpy().reshape(self.shape)
        return float(np.sqrt(np.mean([power(view.T).mean() for view in views])))  # one by one, for memory


class TrialWatch:
    """The `watch` of `ASDPOCS._run` that scores a trial after every pass, and keeps its best volume.

    Parameters
    ----------
    score : Score
        Score of the held-out views, on the trial's voxels.
    beat : float or None
        Score to fall below by the pass `by`, else the trial ends there; None: it goes on.
    slow : bool
        Whether the trial ends, too, when `PATIENCE` passes lower its score by less than `GAIN`.
    """

    def __init__(self, score: Score, trial: Trial, beat: float | None = None, by: int = 0, slow: bool = False):
        self.score, self.trial, self.beat, self.by, self.slow = score, trial, beat, by, slow

    def __call__(self, done: int, x: mi.Float) -> bool:
        trial = self.trial
        trial.scores.append(self.score(x))
        if trial.niter == done:
            trial.volume = x.numpy().reshape(self.score.size)
        if self.beat is not None and done == self.by and trial.score >= self.beat:
            return True
        if self.slow and done > PATIENCE and trial.score > (1 - GAIN) * min(trial.scores[:-PATIENCE]):
            return True
        return done - trial.niter >= PATIENCE
