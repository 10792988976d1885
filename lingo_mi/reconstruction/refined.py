"""A volume on voxels that starts from a cloud's own: the best that a few views and a fitted cloud give (docs/results.md)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from lingo_mi.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.reconstruction.asd_pocs import asd_pocs, check_parameters
from lingo_mi.reconstruction.sart import passes, sweep
from lingo_mi.reconstruction.system import Reconstruction, System, check_counts
from lingo_mi.reconstruction.wide_pixels import excess_width
from lingo_mi.scan import Scan

SPREAD = 1.0  # standard deviation in voxels of what `structure` means by around a voxel
LMBDA_RED = 0.99  # of `sart`
FLOOR = 0.05  # least weight over the root of the mean square


def refined(
    scan: Scan,
    niter: int = 20,
    completed_niter: int = 1,
    tviter: int = 20,
    alpha: float = 0.12,
    alpha_red: float = 0.87,
    rmax: float = 0.65,
    maxl2err: float = 0.0,
    exact_every: int = 5,
    finer: int = 1,
    seed: int = 0,
    *,
    sample,
    completed: Scan | None = None,
    progress=None,
) -> Reconstruction:
    """SART on views completed from a cloud, then ASD-POCS on the measured ones alone.

    The cloud's views are wrong by little, but where the measured ones see nothing; so they are met first, and what they have
    wrong is put right by the measured ones. What a ray lacks is given to its voxels by the `structure` around them: a cloud is
    wrong at edges, hardly where it is even. Where pixels are wider than voxels, what a pass changes is blurred to their width
    (`excess_width`). Total variation is smoothed away in long steps, which shorten until they change the volume by `rmax` of
    what the data do. Where Joseph's projector is off, the projections are corrected for it.

    Structure finer than the voxels has no place on them and becomes streaks. The cloud has no voxels, so that it may be sampled
    on smaller ones: with `finer` all of this is done on these, and their means are returned. It pays for clean projections of
    objects finer than the voxels. One that was simulated on these very voxels is blurred by it, and noise finds more room
    (docs/results.md, "Better volumes from 25 views").

    scan              measured projections and geometry
    niter             passes over the measured views
    completed_niter   passes over the completed views before; 0 for none
    tviter, alpha, alpha_red, rmax, maxl2err, exact_every
                      of `asd_pocs`. The defaults are for clean projections; with noise, maxl2err says how well to meet them
    finer             parts along each side of a voxel; memory grows with its cube
    seed              of the random orders
    sample            the cloud's densities per mm [x, y, z] at the voxel centres of a geometry, a function of that
    completed         measured views, which come first, and those between (`two_stage.filled`); None where completed_niter is 0
    progress          called as progress(passes done, passes, residual)

    The residuals are those of the measured views. Raises InputError as `asd_pocs` does, and where `completed` is missing.
    """
    check_counts(least=0, completed_niter=completed_niter)
    check_parameters(
        niter=niter,
        tviter=tviter,
        alpha=alpha,
        alpha_red=alpha_red,
        rmax=rmax,
        maxl2err=maxl2err,
        exact_every=exact_every,
        seed=seed,
    )  # before the passes
    if completed_niter and completed is None:
        raise InputError('completed_niter must be 0 where no completed views are given')
    shape, passes = scan.geometry.nVoxel, completed_niter + niter

    def of_stage(before):
        return progress and (lambda done, _, residual: progress(before + done, passes, residual))

    scan = replace(scan, geometry=divided(scan.geometry, finer))
    volume, blur = sample(scan.geometry), excess_width(scan.geometry)
    if completed_niter:
        completed = replace(completed, geometry=divided(completed.geometry, finer))
        volume = met(completed, completed_niter, volume, blur, seed, of_stage(0))
    found = asd_pocs(
        scan,
        niter,
        tviter=tviter,
        alpha=alpha,
        alpha_red=alpha_red,
        rmax=rmax,
        maxl2err=maxl2err,
        exact_every=exact_every,
        init=volume,
        weights=structure(volume),
        blur=blur,
        seed=seed,
        progress=of_stage(completed_niter),
    )
    parts = [n for count in shape for n in (count, finer)]
    return replace(found, volume=found.volume.reshape(parts).mean((1, 3, 5)))


def met(scan: Scan, niter: int, volume, blur, seed: int, progress) -> np.ndarray:
    """A volume after `sart` from this one, weighted by its own `structure`; without residuals, which nobody reads."""
    system, order = System(scan, structure(volume), blur), passes(scan.geometry.angles, 1, 'random', seed)
    x = system.start(volume)
    for k in range(niter):
        x = sweep(system, x, LMBDA_RED**k, next(order), True)
        if progress:
            progress(k + 1, niter, None)
    return system.volume(x)


def structure(volume) -> np.ndarray:
    """How much a volume [x, y, z] changes around each voxel, as weights for `sart`: the root of the mean square gradient there.

    Nowhere below `FLOOR` of its own root mean square, so that nothing is held fast; ones for a volume that is the same throughout.
    """
    square = np.zeros_like(volume)
    for axis, count in enumerate(volume.shape):
        if count > 1:
            square += np.gradient(volume, axis=axis) ** 2
    ndimage.gaussian_filter(square, SPREAD, output=square)
    mean = square.mean(dtype=np.float64)
    return np.sqrt(np.maximum(square, FLOOR**2 * mean, out=square)) if mean > 0 else np.ones_like(volume)


def divided(geometry: Geometry, finer: int) -> Geometry:
    """The same scan of a volume of `finer` times as many voxels along each side.

    Raises InputError where that is no number from 1 on.
    """
    check_counts(finer=finer)
    return geometry.with_volume([finer * n for n in geometry.nVoxel], [d / finer for d in geometry.dVoxel])
