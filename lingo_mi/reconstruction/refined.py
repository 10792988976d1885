"""A volume on voxels that starts from a cloud's own: the best that few views and a fitted cloud give (docs/benchmarks)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lingo_mi.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.asd_pocs import ASDPOCS
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.sart import passes, sweep
from lingo_mi.reconstruction.system import System, on_voxels
from lingo_mi.reconstruction.wide_pixels import excess_width
from lingo_mi.scan import Scan

SPREAD = 1.0  # standard deviation in voxels of what `structure` means by around a voxel
LMBDA_RED = 0.99  # of the passes over completed views, as `SART`'s
FLOOR = 0.05  # least weight over the root of the mean square


@dataclass(frozen=True)
class Refined(Algorithm):
    """SART on views completed from a cloud, then ASD-POCS on the measured ones alone, both from the cloud's own volume.

    The cloud's views are wrong by little, but where the measured ones see nothing; so they are met first, and what they have
    wrong is put right by the measured ones. Both passes P, over completed and over measured views, weigh the voxels by the
    `structure` s of the volume V that they start from, and where pixels are wider than voxels, blur G what they change to the
    pixels' width (`excess_width`):

        x  <-  x + lmbda s (A_b^T W (b - A_b x)) / (A_b^T 1),  W = 1 / (A_b s),  s = root mean square gradient of V
        x  <-  max(x + G (P(x) - x), 0)

    for a cloud is wrong at edges, hardly where it is even. Total variation is smoothed away in long steps, which shorten until
    they change the volume by `rmax` of what the data do. Where Joseph's projector is off, the projections are corrected for it.

    Structure finer than the voxels has no place on them and becomes streaks. The cloud has no voxels, so that it may be sampled
    on smaller ones: with `finer` all of this is done on these, and their means are returned. It pays for clean projections of
    objects finer than the voxels. One that was simulated on these very voxels is blurred by it, and noise finds more room
    (docs/benchmarks/volumes.md, "Better volumes from 25 views").

    niter             passes over the measured views, from 1 on
    completed_niter   passes over the completed views before, from 0 on
    tviter, alpha, alpha_red, rmax, maxl2err, exact_every
                      of `ASDPOCS`. The defaults are for clean projections; with noise, maxl2err says how well to meet them
    finer             parts along each side of a voxel, from 1 on; memory grows with its cube
    seed              of the random orders, from 0 on

    Prefer it for few views wherever a cloud has been fitted to them (`lingo_mi.completion` prepares what it needs).

        >>> from lingo_mi.phantoms import make, x3d_scan
        >>> found = x3d_scan.scan(make('foot', 24), views=10, pixels=48)
        >>> near = SART(niter=1).run(found.train)  # in the place of a cloud's volume
        >>> refined = Refined(niter=5, completed_niter=0).run(found.train, start=near)
        >>> refined.residuals[-1] < 0.5 * near.residuals[-1]
        True

    Raises InputError for an option out of its range.
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
        self._on_measured()  # checks the other options

    def steps(self, scan: Scan) -> int:
        return self.completed_niter + self.niter

    def grid(self, geometry: Geometry) -> Geometry:
        return geometry.with_volume(
            [self.finer * n for n in geometry.nVoxel], [d / self.finer for d in geometry.dVoxel]
        )

    def run(
        self,
        scan: Scan,
        *,
        start: ArrayLike | None = None,
        progress: Progress | None = None,
        sample: Callable[[Geometry], np.ndarray] | None = None,
        completed: Scan | None = None,
    ) -> Reconstruction:
        """Reconstruct the volume of measured projections. The residuals are theirs.

        start       the cloud's volume [x, y, z], density per mm; in its place, and where `finer` is above 1:
        sample      the cloud's densities per mm [x, y, z] at the voxel centres of a geometry, a function of that
        completed   measured views, then those between (`completion.views.insert_views`); None where completed_niter is 0
        progress    called as progress(passes done, passes, residual), None for the residual of completed views

        Raises InputError where one of these is missing or does not fit the geometry, and where the result is not finite.
        """
        began = time.perf_counter()
        geometry, steps = scan.geometry, self.steps(scan)
        if self.completed_niter and completed is None:
            raise InputError('completed_niter must be 0 where no completed views are given')
        fine = self.grid(geometry)
        if sample is not None and start is None:
            volume = sample(fine)
        elif start is None or sample is not None:
            raise InputError("refined starts from a cloud's volume: give it as start, or a function for it as sample")
        elif self.finer > 1:
            raise InputError("finer needs the cloud's densities on smaller voxels: give sample in the place of start")
        else:
            volume = on_voxels(start, geometry, 'start volume')
        scan, blur = replace(scan, geometry=fine), excess_width(fine)
        if completed is not None and self.completed_niter:
            completed = replace(completed, geometry=self.grid(completed.geometry))
            volume = _on_completed(
                completed, self.completed_niter, volume, blur, self.seed, _continued(progress, 0, steps)
            )
        found = self._on_measured().run(
            scan,
            start=volume,
            progress=_continued(progress, self.completed_niter, steps),
            weights=structure(volume),
            blur=blur,
        )
        parts = [n for count in geometry.nVoxel for n in (count, self.finer)]
        means = found.volume.reshape(parts).mean((1, 3, 5))
        return Reconstruction(means, found.residuals, time.perf_counter() - began, geometry)

    def _on_measured(self) -> ASDPOCS:
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
    """`progress` for one of several stages, of `steps` together, `before` of which are done."""
    if progress is None:
        return None
    return lambda done, _, residual: progress(before + done, steps, residual)


def _on_completed(scan: Scan, niter: int, volume: np.ndarray, blur, seed: int, progress: Progress | None) -> np.ndarray:
    """A volume after passes of SART from this one, weighted by its own `structure`; without residuals, which nobody reads."""
    system, order = System(scan, structure(volume), blur), passes(scan.geometry.angles, 1, 'random', seed)
    x = system.start(volume)
    for k in range(niter):
        x = sweep(system, x, LMBDA_RED**k, next(order), True)
        if progress:
            progress(k + 1, niter, None)
    return system.volume(x)


def structure(volume: np.ndarray) -> np.ndarray:
    """How much a volume [x, y, z] changes around each voxel, as weights for SART: the root of the mean square gradient there.

    Nowhere below `FLOOR` of its own root mean square, so that nothing is held fast; ones where a volume is the same throughout.
    """
    square = np.zeros_like(volume)
    for axis, count in enumerate(volume.shape):
        if count > 1:
            square += np.gradient(volume, axis=axis) ** 2
    ndimage.gaussian_filter(square, SPREAD, output=square)
    mean = square.mean(dtype=np.float64)
    return np.sqrt(np.maximum(square, FLOOR**2 * mean, out=square)) if mean > 0 else np.ones_like(volume)
