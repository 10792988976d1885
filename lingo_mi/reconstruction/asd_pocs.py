"""ASD-POCS: SART steps towards the data, balanced with steepest descent on total variation."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import ClassVar

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.parameters import LARGE, check_bound, check_counts, check_order, check_range
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.reconstruction.sart import passes, sweep, updates
from lingo_mi.reconstruction.slab_descent import Changes, DescentPlan
from lingo_mi.reconstruction.slab_sweeps import swept
from lingo_mi.reconstruction.system import System, dot, evaluated, norm
from lingo_mi.reconstruction.tv_descent import minimise_tv
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import as_path

LMBDA_MIN = 0.005


@dataclass(frozen=True)
class ASDPOCS(Algorithm):
    """Adaptive steepest descent, projection onto convex sets: a volume that matches the data and has small total variation.

    Each pass P of `OSSART` towards the data is followed by `tviter` steps down the total variation TV,

        x  <-  P(x),        x  <-  x - step grad TV(x) / |grad TV(x)|,  tviter times

    The first step is `alpha` times the change by the first P. As long as the data are not matched, the step shrinks by
    `alpha_red` whenever the descent changes the volume by more than `rmax` times the change by P.

    It stops when the data are matched and both parts of a pass cancel (cosine below -0.99), or when lmbda falls below 0.005.
    The volume is taken after the descent, as in TIGRE, and residuals before it. They are computed in the passes that need them,
    and in the last one.

    Use it for few views of objects with large uniform regions. For noisy projections, maxl2err sets how closely to match them.

    Sidky and Pan, "Image reconstruction in circular cone-beam computed tomography by constrained, total-variation minimization",
    Phys. Med. Biol. 53 (2008), algorithm of section 2.3; the defaults of lmbda, lmbda_red, tviter, alpha, alpha_red, rmax and
    blocksize are TIGRE's.

    Parameters
    ----------
    niter : int
        Passes over all views, at least 1; it may stop earlier.
    blocksize : int
        Views per update of P (1: SART, else OS-SART).
    lmbda : float
        Relaxation of P, 0 < lmbda <= 2; multiplied by `lmbda_red` after every pass.
    lmbda_red : float
        0 < lmbda_red <= 1.
    tviter : int
        Steps of steepest descent per pass, at least 1.
    alpha : float
        Length of the first step, relative to the change by the first P, above 0.
    alpha_red : float
        Factor on the length, 0 < alpha_red <= 1.
    rmax : float
        Largest change by descent, relative to that by P, above 0.
    maxl2err : float or None
        |A x - b| at which the data count as matched, density times mm, at least 0. None: 0.2 |A fdk(b) - b|; 0 for scans that FDK
        cannot reconstruct, so that the step shrinks whenever total variation changes too much.
    noneg : bool
        Whether P sets negative densities to zero.
    OrderStrategy : str
        Order of the blocks, see `OSSART`.
    exact_every : int
        Passes between corrections for the error of Joseph's projector (`System.correct`), from the first pass on; 0: no
        corrections.
    seed : int
        Seed of the random order, at least 0.

    Raises
    ------
    InputError
        For an option out of its range.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> measured = x3d_scan.scan(make('foot', 24), views=20, pixels=48).train
    >>> found = lm.reconstruct(measured, lm.ASDPOCS(niter=5), progress=False)
    >>> len(found.residuals), found.residuals[-1] < 0.05
    (6, True)
    """

    name: ClassVar[str] = 'asd-pocs'

    niter: int = 50
    blocksize: int = 1
    lmbda: float = 1.0
    lmbda_red: float = 0.99
    tviter: int = 20
    alpha: float = 0.002
    alpha_red: float = 0.95
    rmax: float = 0.95
    maxl2err: float | None = None
    noneg: bool = True
    OrderStrategy: str = 'random'
    exact_every: int = 0
    seed: int = 0

    def __post_init__(self):
        check_counts(niter=self.niter, blocksize=self.blocksize, tviter=self.tviter)
        check_counts(least=0, exact_every=self.exact_every, seed=self.seed)
        check_range('lmbda', self.lmbda, 0, 2)
        check_range('lmbda_red', self.lmbda_red, 0, 1)
        check_range('alpha', self.alpha, 0, LARGE)
        check_range('alpha_red', self.alpha_red, 0, 1)
        check_range('rmax', self.rmax, 0, LARGE)
        check_order(self.OrderStrategy)
        if self.maxl2err is not None:
            check_bound('maxl2err', self.maxl2err)

    def _run(
        self,
        scan: Scan,
        *,
        start: ArrayLike | None = None,
        progress: Progress | None = None,
        weights: ArrayLike | None = None,
        blur: Sequence[float] | None = None,
        watch: Callable[[int, mi.Float], bool] | None = None,
    ) -> Reconstruction:
        """Reconstruct the volume of a scan, see `run_algorithm`. `weights` and `blur` of P are as in `Sweeps._run`.

        Parameters
        ----------
        watch : callable or None
            Called after every pass as watch(passes done, volume on the device, mi.Float [voxels]); True stops.
        """
        began = time.perf_counter()
        order = passes(scan.geometry.angles, self.blocksize, self.OrderStrategy, self.seed)
        system = System(scan, weights, blur)
        x = system.start(start)
        maxl2err = self._maxl2err(system, scan)
        residuals = [system.relative(system.b) if start is None else system.residual(x)[1]]
        projected, lmbda, step = x, self.lmbda, 0.0

        def error() -> float:
            """|A x - b| before the descent of this pass. Computed when it decides, since it takes a third as long as P."""
            if np.isnan(residuals[-1]):
                residuals[-1] = system.residual(projected)[1]
            return residuals[-1] * system.size_b

        def unmatched() -> bool:
            return maxl2err == 0 or error() > maxl2err

        for k in range(self.niter):
            if self.exact_every and k % self.exact_every == 0:
                system.correct(x)
            projected = x  # no more volumes than are needed
            projected = sweep(system, x, lmbda, next(order), self.noneg)
            residuals.append(np.nan)
            data_change = evaluated(projected - x)
            x = projected
            data_length = norm(data_change)
            if k == 0:
                step = self.alpha * data_length
            x = minimise_tv(x, scan.geometry.grid.shape, step, self.tviter)
            tv_change = evaluated(x - projected)
            changes = Changes(data_length, norm(tv_change), dot(data_change, tv_change))
            step = self.next_step(step, changes, unmatched)
            lmbda *= self.lmbda_red
            if progress:
                progress(k + 1, self.niter, None if np.isnan(residuals[-1]) else residuals[-1])
            if self.ends(lmbda, changes, unmatched):
                break
            if watch is not None and watch(k + 1, x):
                break
        error()  # of the last pass in any case
        return Reconstruction(system.volume(x), residuals, time.perf_counter() - began, scan.geometry.grid)

    def slabs(
        self, scan: Scan, thickness: int, folder: str | PathLike, *, progress: Progress | None = None
    ) -> Iterator[np.ndarray]:
        """Reconstruct the volume in slabs along z, as `Sweeps.slabs` does.

        Parameters
        ----------
        scan : Scan
            Projections as for `lm.reconstruct`.
        thickness : int
            Slices of a slab.
        folder : path-like
            Folder of the work, which holds four volumes. The same call goes on with it.
        progress : Progress or None
            Called between the steps of all slabs.

        Yields
        ------
        ndarray
            Float32 [x, y, thickness], from the first slab on; the last may be thinner.

        Raises
        ------
        InputError
            If `exact_every` is above 0, if rays leave voxels out, for too little memory or room on the disk, and for a folder
            that holds other work.

        Examples
        --------
        >>> for slab in ASDPOCS(niter=4).slabs(scan, 64, 'out/work'):
        ...     ...
        """
        return swept(scan, self.plan(scan), thickness, as_path('folder', folder), progress)

    def plan(self, scan: Scan) -> DescentPlan:
        """Return the plan by which the volume is made in slabs.

        Raises
        ------
        InputError
            If `exact_every` is above 0.
        """
        if self.exact_every:
            raise InputError(
                'slabs know no corrections of the projector: leave out exact_every, or make the volume whole'
            )
        return DescentPlan(updates(scan, self), self.noneg, self)

    def slab_steps(self, scan: Scan, thickness: int) -> int:
        """The largest number of steps of `slabs`, for `progress`."""
        versions = self.niter * (-(-len(scan) // self.blocksize) + self.tviter)
        return versions * len(scan.geometry.grid.slabs(thickness))

    def next_step(self, step: float, changes: Changes, unmatched: Callable[[], bool]) -> float:
        """The step of the next pass. unmatched: whether |A x - b| is above `maxl2err`, asked only if that decides."""
        return step * self.alpha_red if changes.descent > self.rmax * changes.data and unmatched() else step

    def ends(self, lmbda: float, changes: Changes, unmatched: Callable[[], bool]) -> bool:
        """Return whether a pass is the last one. lmbda is the rate of the next pass."""
        cosine = changes.product / max(changes.data * changes.descent, 1e-30)
        return (cosine < -0.99 and not unmatched()) or lmbda < LMBDA_MIN

    def _maxl2err(self, system: System, scan: Scan) -> float:
        """|A x - b| at which the data count as matched."""
        if self.maxl2err is not None:
            return self.maxl2err
        if not can_rectify(scan):
            return 0.0
        return 0.2 * system.residual(system.start(FDK()._run(scan).volume))[1] * system.size_b
