"""Penalised least squares: the volume that explains the projections and agrees with a prior."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, require_type, shown
from lingo_mi.effects.forward import Effects
from lingo_mi.functional.linear_map import LinearMap
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.held_out import Score, split_views
from lingo_mi.reconstruction.parameters import LARGE, check_bound, check_counts, check_range
from lingo_mi.reconstruction.priors import TV, Prior
from lingo_mi.reconstruction.system import System, dot, evaluated, on_voxels, scalar
from lingo_mi.reconstruction.voxel_values import means
from lingo_mi.scan import Scan

ACCURACY, SAFE = 1e-2, 1.02  # accuracy of the norm of A; factor on its square that makes up for the inaccuracy
PATH = 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5  # strengths to choose from
FIRST, MOST = 2, 5  # which of them is tried first; how many trials at most
TRIED = 30  # iterations for each of them; each goes on from the volume of the one before
SLACK = 1.015  # times the least score: as good as the best
WEIGHTS = 'known', 'photons', 'equal'


@dataclass(frozen=True)
class PenalisedLeastSquares(Algorithm):
    """Least squares with a prior: minimises 1/2 (A x - b)^T W (A x - b) + strength max(A^T W b) R(x) over 0 <= x <= `upper`.

    R is the prior. Its proximal map follows each step of gradient descent, whose length is 1 / |A^T W A|. The gradient of a
    prior's smooth part is added to the gradient of the data term. Nesterov's momentum accelerates the steps (FISTA), and is reset
    when it points uphill. Ordered subsets with momentum come near the minimum in a third of the passes, but apply the map more
    often, and stop before the minimum.

    Parameters
    ----------
    prior : Prior
        `TV` (total variation), another one of `lingo_mi.reconstruction.priors`, or one that you wrote.
    strength : float, optional
        Strength of the prior relative to max(A^T W b), so that it does not depend on units. None: of six strengths from 1e-2 to
        3e-5, the strongest that predicts held-out views nearly as well as the best one (`held_out.Score`). The search takes up
        to 150 further iterations.
    niter : int
        Iterations, at least 1. Each takes one projection and one backprojection of all views.
    upper : float, optional
        Largest density, 1/mm, above 0.
    finer : int
        Parts along each side of a voxel, at least 1, for objects finer than the voxels. The volume is the mean of a voxel's
        parts.
    held_out : int
        One view in `held_out` is held out to choose the strength, at least 2.
    weights : {'known', 'photons', 'equal'}
        W. 'equal': the same for all rays. 'photons': the fraction of photons that a ray transmits, exp(-b), because the variance
        of a line integral is inversely proportional to it. 'known': 'photons' if the detector of the scan names its photons,
        otherwise 'equal'. The mean of W over the rays is 1.

    References
    ----------
    Beck and Teboulle, "A fast iterative shrinkage-thresholding algorithm for linear inverse problems", SIAM J. Imaging Sci. 2
    (2009); O'Donoghue and Candès, "Adaptive restart for accelerated gradient schemes", Found. Comput. Math. 15 (2015); for the
    weights Sauer and Bouman, "A local update strategy for iterative reconstruction from projections", IEEE TSP 41 (1993).

    Raises
    ------
    InputError
        For an option out of its range, and for a scan of fewer than four views without a strength.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> measured = x3d_scan.scan(make('foot', 24), views=20, pixels=48).train
    >>> result = lm.reconstruct(measured, lm.PenalisedLeastSquares(lm.TV(), strength=1e-4, niter=20), progress=False)
    >>> result.residuals[-1] < 0.05
    True
    """

    name: ClassVar[str] = 'pls'

    prior: Prior = field(default_factory=TV)
    strength: float | None = None
    niter: int = 60
    upper: float | None = None
    finer: int = 1
    held_out: int = 5
    weights: str = 'known'

    def __post_init__(self):
        require_type('prior', self.prior, Prior, 'such as lm.TV() or lm.Denoiser(function)')
        check_counts(niter=self.niter, finer=self.finer)
        check_counts(least=2, held_out=self.held_out)
        if self.strength is not None:
            check_bound('strength', self.strength)
        if self.upper is not None:
            check_range('upper', self.upper, 0, LARGE)
        if self.weights not in WEIGHTS:
            raise InputError(f'weights must be one of {", ".join(WEIGHTS)}, not {shown(self.weights)}')

    def seeing(self, effects: Effects | None) -> PenalisedLeastSquares:
        counts = effects is not None and effects.detector is not None and effects.detector.photons > 0
        return replace(self, weights='photons') if counts and self.weights == 'known' else self

    def steps(self, scan: Scan) -> int:
        return self.niter + (TRIED * MOST if self.strength is None else 0)

    def grid(self, geometry: Geometry) -> Grid:
        return geometry.grid.finer(self.finer)

    @property
    def volumes(self) -> float:
        return self.prior.volumes

    def _run(self, scan: Scan, *, start: ArrayLike | None = None, progress: Progress | None = None) -> Reconstruction:
        """Reconstruct the volume of a scan, see `run_algorithm`."""
        began, grid = time.perf_counter(), scan.geometry.grid
        if start is not None and self.finer > 1:
            start = np.asarray(start)
            if start.shape != grid.finer(self.finer).shape:
                start = np.kron(on_voxels(start, scan.geometry, 'start volume'), np.ones((self.finer,) * 3, np.float32))
        scan, done = scan.on(grid.finer(self.finer)), 0
        strength = self.strength
        if strength is None:
            train, held_out = split_views(scan, self.held_out)
            strength, start, _, done = self.search(train, held_out, start, progress, self.steps(scan))
        solver = self._solver(scan)
        x = solver.system.start(start)
        residuals = [solver.system.residual(x)[1]]
        steps = self.steps(scan)

        def after_step(k: int) -> None:
            residuals.append(solver.residual)
            if progress is not None:
                progress(steps if k == self.niter else done + k, steps, residuals[-1])

        x = solver.minimise(x, strength, self.niter, after_step)
        # A step gives the residual of the volume that it starts from.
        residuals = [*residuals[:1], *residuals[2:], solver.system.residual(x)[1]]
        volume = means(solver.system.volume(x), self.finer) if self.finer > 1 else solver.system.volume(x)
        return Reconstruction(volume, residuals, time.perf_counter() - began, grid)

    def _solver(self, scan: Scan) -> Solver:
        return Solver(
            System(scan), self.prior, math.inf if self.upper is None else self.upper, self.weights == 'photons'
        )

    def search(
        self, train: Scan, held_out: Scan, start: ArrayLike | None, progress: Progress | None, steps: int
    ) -> tuple[float, np.ndarray, list[float], int]:
        """The strongest prior that predicts held-out views nearly as well as the best, the volume of the best, all scores, and
        the steps done.

        The search goes towards weaker priors while these predict clearly better, then back towards stronger ones while these
        predict as well: by then the volume is near its minimum, and scores can be compared. Among those that predict alike the
        strongest is taken, as in the rule of one standard error (Breiman et al., "Classification and Regression Trees", 1984).

        Parameters
        ----------
        steps : int
            For `progress`.
        """
        score, solver = Score(held_out), self._solver(train)
        scores: dict[int, float] = {}
        best, done = solver.system.start(start), 0

        def after_step(_: int) -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, steps, solver.residual)

        def tried(i: int, x: mi.Float) -> mi.Float:
            nonlocal best
            x = solver.minimise(x, PATH[i], TRIED, after_step)
            value = score(x)
            if value < min(scores.values(), default=math.inf):
                best = x
            scores[i] = value
            return x

        x, i, trials = tried(FIRST, best), FIRST, 1
        while trials < MOST - 1 and i + 1 < len(PATH):
            weaker, trials = tried(i + 1, x), trials + 1
            if scores[i + 1] * SLACK > scores[i]:
                break
            x, i = weaker, i + 1
        while trials < MOST and i > 0:
            x, i, trials = tried(i - 1, x), i - 1, trials + 1
            if scores[i] > SLACK * min(scores.values()):
                break
        chosen = min(i for i, error in scores.items() if error <= SLACK * min(scores.values()))
        return PATH[chosen], solver.system.volume(best), list(scores.values()), done


class Solver:
    """Accelerated proximal gradient descent on one scan.

    Parameters
    ----------
    weighted : bool
        Whether W is exp(-b).

    Attributes
    ----------
    residual
        |A x - b| / |b| where the last step began.
    """

    def __init__(self, system: System, prior: Prior, upper: float, weighted: bool = False):
        self.system, self.prior, self.upper, self.weights = system, prior, upper, None
        if weighted:
            photons = dr.exp(-dr.maximum(system.b, 0))
            self.weights = evaluated(photons * (len(system.views) * system.A.pixels / dr.sum(photons)))
        self.curvature = SAFE * _Rooted(self).norm(ACCURACY) ** 2 or 1.0
        self.scale = float(dr.max(system.A.adjoint(self.weighed(system.b), system.views))[0])
        self.residual = math.nan

    def weighed(self, images: mi.Float) -> mi.Float:
        return images if self.weights is None else evaluated(self.weights * images)

    def minimise(self, x: mi.Float, strength: float, niter: int, after_step: Callable[[int], None]) -> mi.Float:
        """The volume after `niter` steps from x. after_step: called with the number of steps done."""
        system, prior, size = self.system, self.prior, self.system.geometry.grid.shape
        A, views = system.A, system.views
        strength *= self.scale
        step = 1 / (self.curvature + strength * prior.curvature)
        prior.begin()
        y, t = x, 1.0
        for k in range(1, niter + 1):
            r = evaluated(system.b - A.forward(y, views)[0])
            self.residual = system.relative(r)
            down = evaluated(A.adjoint(self.weighed(r), views))
            if strength and (slope := prior.gradient(y, size)) is not None:
                down = dr.fma(scalar(-strength), slope, down)
            new = prior.prox(evaluated(dr.fma(scalar(step), down, y)), strength * step, size, self.upper)
            if dr.width(new) != dr.width(x):
                raise InputError(
                    f'the prior {type(prior).__name__}: prox returns {dr.width(new)} of {dr.width(x)} voxels'
                )
            after = (1 + math.sqrt(1 + 4 * t * t)) / 2
            change = evaluated(new - x)
            uphill = dot(evaluated(y - new), change)
            if not math.isfinite(uphill):
                raise InputError(f'the prior {type(prior).__name__} returns NaN or infinity')
            if uphill > 0:  # the direction of the momentum
                after, y = 1.0, new
            else:
                y = evaluated(dr.fma(scalar((t - 1) / after), change, new))
            x, t = new, after
            after_step(k)
        return x


class _Rooted(LinearMap):
    """The root of W times A, whose norm squared is |A^T W A|."""

    def __init__(self, solver: Solver, back: bool = False):
        self.solver, self.back, A = solver, back, solver.system.A
        self.root = None if solver.weights is None else evaluated(dr.sqrt(solver.weights))
        shapes = (A.voxels,), (len(solver.system.views) * A.pixels,)
        self.domain_shape, self.range_shape = shapes[::-1] if back else shapes

    @cached_property
    def T(self) -> _Rooted:
        return _Rooted(self.solver, not self.back)

    def on_device(self, x):
        A, views = self.solver.system.A, self.solver.system.views
        if self.back:
            return evaluated(A.adjoint(x if self.root is None else evaluated(self.root * x), views))
        out = A.forward(x, views)[0]
        return evaluated(out if self.root is None else self.root * out)
