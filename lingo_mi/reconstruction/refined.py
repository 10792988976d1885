"""The best voxel volume from few views and a fitted cloud; it starts from the cloud's volume (docs/benchmarks/volumes.md)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.asd_pocs import ASDPOCS
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.sart import passes, sweep
from lingo_mi.reconstruction.system import System, on_voxels
from lingo_mi.reconstruction.voxel_values import means
from lingo_mi.reconstruction.wide_pixels import excess_width
from lingo_mi.scan import Scan

SPREAD = 1.0  # neighbourhood of a voxel in `structure`: standard deviation, voxels
LMBDA_RED = 0.99  # reduction of lmbda per pass over completed views, as in `SART`
FLOOR = 0.05  # least weight, relative to the root mean square of all


@dataclass(frozen=True)
class Refined(Algorithm):
    """SART on views completed from a cloud, then ASD-POCS on the measured views, starting from the cloud's own volume.

    Rendered views are accurate except in places that no measured view constrains. They are fitted first, and the measured views
    then correct their errors. A pass P over the completed or the measured views weights the voxels by the `structure` s of the
    volume V that it starts from. If pixels are wider than voxels, a blur G (`excess_width`) smooths the change to the pixels'
    width:

        x  <-  x + lmbda s (A_b^T W (b - A_b x)) / (A_b^T 1),  W = 1 / (A_b s),  s = root mean square gradient of V
        x  <-  max(x + G (P(x) - x), 0)

    The weights follow s, because a cloud errs at edges and hardly in uniform regions. TV steps start long, and shorten until
    they change the volume by `rmax` times the change by the data steps. The projections are corrected for the error of Joseph's
    projector (`exact_every`).

    Structure finer than the voxels causes streaks. A cloud can be sampled on smaller voxels: with `finer`, all steps use these,
    and the result is their mean over each voxel. This helps for clean projections of objects finer than the voxels. It blurs
    an object that was simulated on the scan's own voxels, and lets in more noise (docs/benchmarks/volumes.md).

    Use it for few views if a cloud has been fitted to them (`lingo_mi.completion` prepares its inputs).

    Parameters
    ----------
    niter : int
        Passes over the measured views, at least 1.
    completed_niter : int
        Earlier passes over the completed views, at least 0.
    tviter, alpha, alpha_red, rmax, maxl2err, exact_every
        See `ASDPOCS`. The defaults are for clean projections; with noise, maxl2err sets how closely to match them.
    finer : int
        Parts along each side of a voxel, at least 1; memory grows with its cube.
    seed : int
        Seed of the random orders, at least 0.

    Raises
    ------
    InputError
        For an option out of its range.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> found = x3d_scan.scan(make('foot', 24), views=10, pixels=48)
    >>> near = lm.reconstruct(found.train, lm.SART(niter=1), progress=False)  # in the place of a cloud's volume
    >>> refined = lm.reconstruct(found.train, lm.Refined(niter=5), start=near, progress=False)
    >>> refined.residuals[-1] < 0.5 * near.residuals[-1]
    True
    """

    name: ClassVar[str] = 'refined'

    niter: int = 20
    completed_niter: int = 1
    tviter: int = 20
    alpha: float = 0.12
    alpha_red: float = 0.87
    rmax: float = 0.65
    maxl2err: float = 0.0
    exact_every: int = 5
    finer: int = 1
    seed: int = 0

    def __post_init__(self):
        check_counts(least=0, completed_niter=self.completed_niter)
        check_counts(finer=self.finer)
        self.on_measured()  # checks the other options

    def steps(self, scan: Scan) -> int:
        return self.completed_niter + self.niter

    def grid(self, geometry: Geometry) -> Grid:
        return geometry.grid.finer(self.finer)

    def _run(
        self,
        scan: Scan,
        *,
        start: ArrayLike | None = None,
        progress: Progress | None = None,
        sample: Callable[[Grid], np.ndarray] | None = None,
        completed: Scan | None = None,
    ) -> Reconstruction:
        """Reconstruct the volume from measured projections. The residuals belong to the measured views.

        Parameters
        ----------
        start : array_like or None
            The cloud's volume [x, y, z], density per mm; give either this or `sample`.
        sample : callable or None
            Function of a grid: the cloud's densities per mm [x, y, z] at its voxel centres; needed for `finer` > 1.
        completed : Scan or None
            The measured views, then those between (`completion.views.insert_views`); None if completed_niter is 0.
        progress : Progress or None
            Called as progress(passes done, passes, residual); the residual is None in passes over completed views.

        Raises
        ------
        InputError
            If an input is missing or does not fit the geometry, and if the result is not finite.
        """
        began = time.perf_counter()
        geometry, steps = scan.geometry, self.steps(scan)
        if self.completed_niter and completed is None:
            raise InputError('completed_niter must be 0 if no completed views are given')
        fine = self.grid(geometry)
        if sample is not None and start is None:
            volume = sample(fine)
        elif start is None or sample is not None:
            raise InputError("refined starts from a cloud's volume: give it as start, or a function for it as sample")
        elif self.finer > 1:
            raise InputError("finer needs the cloud's densities on smaller voxels: give the fit as start")
        else:
            volume = on_voxels(start, geometry, 'start volume')
        scan = scan.on(fine)
        blur = excess_width(scan.geometry)
        if completed is not None and self.completed_niter:
            completed = completed.on(self.grid(completed.geometry))
            volume = _on_completed(
                completed, self.completed_niter, volume, blur, self.seed, _continued(progress, 0, steps)
            )
        result = self.on_measured()._run(
            scan,
            start=volume,
            progress=_continued(progress, self.completed_niter, steps),
            weights=structure(volume),
            blur=blur,
        )
        return Reconstruction(
            means(result.volume, self.finer), result.residuals, time.perf_counter() - began, geometry.grid
        )

    def on_measured(self) -> ASDPOCS:
        """The algorithm of the passes over the measured views."""
        return ASDPOCS(
            niter=self.niter,
            tviter=self.tviter,
            alpha=self.alpha,
            alpha_red=self.alpha_red,
            rmax=self.rmax,
            maxl2err=self.maxl2err,
            exact_every=self.exact_every,
            seed=self.seed,
        )


def _continued(progress: Progress | None, before: int, steps: int) -> Progress | None:
    """`progress` for one of several stages: `before` of all `steps` were done in earlier stages."""
    if progress is None:
        return None
    return lambda done, _, residual: progress(before + done, steps, residual)


def _on_completed(scan: Scan, niter: int, volume: np.ndarray, blur, seed: int, progress: Progress | None) -> np.ndarray:
    """The volume after `niter` passes of SART, weighted by the `structure` of the start. No residuals are computed."""
    system, order = System(scan, structure(volume), blur), passes(scan.geometry.angles, 1, 'random', seed)
    x = system.start(volume)
    for k in range(niter):
        x = sweep(system, x, LMBDA_RED**k, next(order), True)
        if progress:
            progress(k + 1, niter, None)
    return system.volume(x)


def structure(volume: np.ndarray) -> np.ndarray:
    """Weights for SART from a volume [x, y, z]: the root mean square gradient around each voxel.

    At least `FLOOR` of the weights' own root mean square, so that every voxel can change. Ones for a constant volume.
    """
    square = np.zeros_like(volume)
    for axis, count in enumerate(volume.shape):
        if count > 1:
            square += np.gradient(volume, axis=axis) ** 2
    ndimage.gaussian_filter(square, SPREAD, output=square)
    mean = square.mean(dtype=np.float64)
    return np.sqrt(np.maximum(square, FLOOR**2 * mean, out=square)) if mean > 0 else np.ones_like(volume)
