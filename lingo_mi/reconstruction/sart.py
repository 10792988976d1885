"""SART, OS-SART and SIRT: one update rule, applied to one view, a block of views, or all views at a time.

Andersen and Kak, "Simultaneous algebraic reconstruction technique", Ultrasonic Imaging 6 (1984). For the rows A_b of a
block,

    x  <-  x + lmbda (A_b^T W (b - A_b x)) / (A_b^T 1),    W = 1 / (A_b 1)

with element-wise divisions. Voxels and pixels without rays stay unchanged. With weights s of the voxels these are the same
steps for z in x = x_0 + diag(s) z, with A diag(s) in place of A:

    x  <-  x + lmbda s (A_b^T W (b - A_b x)) / (A_b^T 1),  W = 1 / (A_b s)

Among all volumes that match the projections, the iteration approaches the one with the smallest change from x_0, measured in
units of s.

Pixels wider than the voxels hardly resolve single voxels, and the steps leave a pattern of the rays. A Gaussian `blur` G
smooths the change that a pass P of these steps makes:

    x  <-  max(x + G (P(x) - x), 0)

A volume that P does not change, the blur does not change either, so the limit still matches the projections. Voxels that
hardly any ray crosses change like their neighbours (`wide_pixels.Between`).

Parameters have the names of TIGRE for Python, if it has them. lmbda, lmbda_red, blocksize and noneg have its defaults;
OrderStrategy has the default of TIGRE for MATLAB.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.parameters import check_bound, check_counts, check_order, check_range
from lingo_mi.reconstruction.sart_update import update
from lingo_mi.reconstruction.slab_sweeps import SweepPlan, Update, swept
from lingo_mi.reconstruction.system import System, evaluated
from lingo_mi.reconstruction.wide_pixels import blurred
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import as_path


def blocks(angles: np.ndarray, blocksize: int, order: str, rng: np.random.Generator) -> list[np.ndarray]:
    """The view numbers [block][view] of one pass: blocks of consecutive views, in one of three orders.

    Parameters
    ----------
    order : str
        'ordered'; 'random'; or 'angularDistance': next is the block farthest on the circle from all previous ones (by the blocks'
        middle views).
    rng : Generator
        For the random order.

    Raises
    ------
    InputError
        For an unknown order.
    """
    check_order(order)
    parts = [np.arange(i, min(i + blocksize, len(angles))) for i in range(0, len(angles), blocksize)]
    if order == 'ordered':
        return parts
    if order == 'random':
        return [parts[i] for i in rng.permutation(len(parts))]
    middle = np.array([angles[p[len(p) // 2]] for p in parts])
    nearest, out = np.full(len(parts), np.inf), [0]
    while len(out) < len(parts):
        nearest = np.minimum(nearest, 1 - np.cos(middle - middle[out[-1]]))
        nearest[out[-1]] = -1
        out.append(int(np.argmax(nearest)))
    return [parts[i] for i in out]


def passes(angles: np.ndarray, blocksize: int, order: str, seed: int) -> Iterator[list[np.ndarray]]:
    """The `blocks` of pass after pass, an endless iterator."""
    rng = np.random.default_rng(seed)
    # The first draw of a seed is skipped: the published numbers belong to the orders that follow it.
    blocks(angles, blocksize, order, rng)
    while True:
        yield blocks(angles, blocksize, order, rng)


def updates(scan: Scan, how: Any) -> list[Update]:
    """The relaxation and the views of every update, in order. how: an `OSSART` or `ASDPOCS`."""
    order = passes(scan.geometry.angles, how.blocksize, how.OrderStrategy, how.seed)
    return [(how.lmbda * how.lmbda_red**k, views) for k in range(how.niter) for views in next(order)]


def sweep(
    system: System, x: mi.Float, lmbda: float, parts: Sequence[Sequence[int] | np.ndarray], noneg: bool
) -> mi.Float:
    """One pass over all blocks of views, from a volume (mi.Float [voxels], density per mm) to the next."""
    start = x
    for views in parts:
        x = update(system, x, views, lmbda, noneg)
    if system.between is None and system.blur is None:
        return x
    change = x - start
    if system.between is not None:
        change = system.between.filled(change)
    if system.blur is not None:
        change = blurred(change, system.geometry.grid.shape, system.blur)
    return evaluated(dr.maximum(start + change, 0) if noneg else start + change)


class Sweeps(Algorithm):
    """SART, OS-SART and SIRT: sweeps over all views in blocks; they differ in the size and the order of the blocks."""

    @abstractmethod
    def _by_blocks(self, views: int) -> OSSART:
        """The same sweeps of a scan with so many views as `OSSART`."""

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
        """Reconstruct the volume of a scan, see `run_algorithm`. Without tol, the residual is not computed after every pass, of
        which it takes a third of the time, but at the end.

        Parameters
        ----------
        weights : array_like or None
            Weights of the voxels [x, y, z], at least 0: relative sizes of their changes (default: equal).
        blur : Sequence[float] or None
            Blur of the change by a pass: standard deviations in voxels along x, y, z (default: none).
        watch : callable or None
            Called after every pass as watch(passes done, volume on the device, mi.Float [voxels]); True stops.
        """
        began, how = time.perf_counter(), self._by_blocks(len(scan))
        order = passes(scan.geometry.angles, how.blocksize, how.OrderStrategy, how.seed)
        system = System(scan, weights, blur)
        x = system.start(start)
        residuals = [system.relative(system.b) if start is None else system.residual(x)[1]]
        for k in range(how.niter):
            if how.tol and residuals[-1] <= how.tol:
                break
            x = sweep(system, x, how.lmbda * how.lmbda_red**k, next(order), how.noneg)
            measured = how.tol or k + 1 == how.niter
            residuals.append(system.residual(x)[1] if measured else np.nan)
            dr.sync_thread()  # Ctrl-C comes through between passes
            if progress:
                progress(k + 1, how.niter, residuals[-1] if measured else None)
            if watch is not None and watch(k + 1, x):
                break
        return Reconstruction(system.volume(x), residuals, time.perf_counter() - began, scan.geometry.grid)

    def slabs(
        self, scan: Scan, thickness: int, folder: str | PathLike, *, progress: Progress | None = None
    ) -> Iterator[np.ndarray]:
        """The volume in slabs of so many slices along z, [x, y, thickness], from the first; the last may be thinner.

        Takes memory for seven slabs, the scan (twice with invalid pixels), and ten images for each view of a block. Stored views
        are read block by block.

        Parameters
        ----------
        folder : path-like
            For the volume while it is made, twice its size; made if missing. If the work was stopped, the same call goes on
            after the last whole update, to the same result. The files stay: remove them when the volume is safe.
        progress : Progress or None
            Called after every slab as progress(slabs updated, slabs to update in all, |A x - b| / |b| of the views of this update
            before it).

        Raises
        ------
        InputError
            If tol is above 0, if rays leave voxels out, for too little memory or room on the disk, and for a folder that holds
            other work.

        Examples
        --------
        >>> for slab in OSSART(niter=4).slabs(scan, 64, 'out/work'):
        ...     ...
        """
        return swept(scan, self.plan(scan), thickness, as_path('folder', folder), progress)

    def plan(self, scan: Scan) -> SweepPlan:
        """All updates of the volume in slabs.

        Raises
        ------
        InputError
            If tol is above 0.
        """
        how = self._by_blocks(len(scan))
        if how.tol:
            raise InputError(
                'slabs do not know the residual of all views: leave out tol, or make the volume without slabs'
            )
        return SweepPlan(updates(scan, how), how.noneg)

    def slab_steps(self, scan: Scan, thickness: int) -> int:
        """The number of steps of `slabs`, for `progress`."""
        how = self._by_blocks(len(scan))
        return how.niter * -(-len(scan) // how.blocksize) * len(scan.geometry.grid.slabs(thickness))


@dataclass(frozen=True)
class OSSART(Sweeps):
    """Ordered-subset SART: the volume is updated after every block of views.

    For the rows A_b of a block, with element-wise divisions,

        x  <-  max(x + lmbda (A_b^T W (b - A_b x)) / (A_b^T 1), 0),    W = 1 / (A_b 1)

    Use it instead of `SART` for many views: a pass has fewer updates, and each averages the noise of its views.

    Wang and Jiang, "Ordered-subset simultaneous algebraic reconstruction techniques (OS-SART)", J. X-Ray Sci. Technol. 12 (2004).

    Parameters
    ----------
    niter : int
        Passes over all views, at least 1.
    blocksize : int
        Views per update, at least 1; the last block of a pass may have fewer.
    lmbda : float
        Relaxation, 0 < lmbda <= 2; multiplied by `lmbda_red` after every pass.
    lmbda_red : float
        0 < lmbda_red <= 1.
    noneg : bool
        Whether negative densities are set to zero after every update.
    OrderStrategy : str
        Order of the blocks: 'ordered', 'random' (another one in every pass) or 'angularDistance' (`blocks`).
    tol : float
        Stop when |A x - b| / |b| falls to this value; with 0, never.
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
    >>> measured = x3d_scan.scan(make('foot', 24), views=40, pixels=48).train
    >>> result = lm.reconstruct(measured, lm.OSSART(niter=4, blocksize=5), progress=False)
    >>> result.volume.shape, result.residuals[-1] < 0.05
    ((24, 24, 24), True)
    """

    name: ClassVar[str] = 'os-sart'

    niter: int = 50
    blocksize: int = 20
    lmbda: float = 1.0
    lmbda_red: float = 0.99
    noneg: bool = True
    OrderStrategy: str = 'random'
    tol: float = 0.0
    seed: int = 0

    def __post_init__(self):
        check_counts(niter=self.niter, blocksize=self.blocksize)
        check_counts(least=0, seed=self.seed)
        check_range('lmbda', self.lmbda, 0, 2)
        check_range('lmbda_red', self.lmbda_red, 0, 1)
        check_order(self.OrderStrategy)
        check_bound('tol', self.tol)

    def _by_blocks(self, views: int) -> OSSART:
        return self


@dataclass(frozen=True)
class SART(Sweeps):
    """Simultaneous algebraic reconstruction: the volume is updated after every view.

    The rule is the same as in `OSSART`, with the rows A_b of one view,

        x  <-  max(x + lmbda (A_b^T W (b - A_b x)) / (A_b^T 1), 0),    W = 1 / (A_b 1)

    Use it for few clean views, which it matches closely after a few passes. With noise, use fewer passes or a smaller lmbda.

    Andersen and Kak, "Simultaneous algebraic reconstruction technique", Ultrasonic Imaging 6 (1984).

    Parameters
    ----------
    niter : int
        Passes over all views, at least 1.
    lmbda : float
        Relaxation, 0 < lmbda <= 2; multiplied by `lmbda_red` after every pass.
    lmbda_red : float
        0 < lmbda_red <= 1.
    noneg : bool
        Whether negative densities are set to zero after every update.
    OrderStrategy : str
        Order of the views: 'ordered', 'random' (another one in every pass) or 'angularDistance' (`blocks`).
    tol : float
        Stop when |A x - b| / |b| falls to this value; with 0, never.
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
    >>> result = lm.reconstruct(measured, lm.SART(niter=3), progress=False)
    >>> better = lm.reconstruct(measured, lm.SART(niter=3, lmbda=0.5), start=result, progress=False)
    >>> better.residuals[-1] < result.residuals[-1] < 0.05
    True
    """

    name: ClassVar[str] = 'sart'

    niter: int = 20
    lmbda: float = 1.0
    lmbda_red: float = 0.99
    noneg: bool = True
    OrderStrategy: str = 'random'
    tol: float = 0.0
    seed: int = 0

    def __post_init__(self):
        self._by_blocks(1)  # checks the options

    def _by_blocks(self, views: int) -> OSSART:
        return OSSART(blocksize=1, **asdict(self))


@dataclass(frozen=True)
class SIRT(Sweeps):
    """Simultaneous iterative reconstruction: each update of the volume uses all views.

    The rule is the same as in `OSSART`, with all rows A,

        x  <-  max(x + lmbda (A^T W (b - A x)) / (A^T 1), 0),    W = 1 / (A 1)

    Use it for noisy views: it approaches a least-squares solution smoothly, with many times the passes of `SART`.
    lmbda=1.9 with lmbda_red=1 is fastest.

    Gilbert, "Iterative methods for the three-dimensional reconstruction of an object from projections", J. Theor. Biol. 36
    (1972), with the weights of Andersen and Kak, Ultrasonic Imaging 6 (1984).

    Parameters
    ----------
    niter : int
        Updates, at least 1.
    lmbda : float
        Relaxation, 0 < lmbda <= 2; multiplied by `lmbda_red` after every update.
    lmbda_red : float
        0 < lmbda_red <= 1.
    noneg : bool
        Whether negative densities are set to zero after every update.
    tol : float
        Stop when |A x - b| / |b| falls to this value; with 0, never.

    Raises
    ------
    InputError
        For an option out of its range.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> measured = x3d_scan.scan(make('foot', 24), views=20, pixels=48).train
    >>> result = lm.reconstruct(measured, lm.SIRT(niter=10, lmbda=1.9, lmbda_red=1.0), progress=False)
    >>> result.residuals[-1] < 0.2 * result.residuals[0]
    True
    """

    name: ClassVar[str] = 'sirt'

    niter: int = 100
    lmbda: float = 1.0
    lmbda_red: float = 0.99
    noneg: bool = True
    tol: float = 0.0

    def __post_init__(self):
        self._by_blocks(1)  # checks the options

    def _by_blocks(self, views: int) -> OSSART:
        return OSSART(blocksize=views, OrderStrategy='ordered', **asdict(self))
