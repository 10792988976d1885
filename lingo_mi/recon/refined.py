"""A volume on voxels that starts from a cloud's own: the best that a few views and a fitted cloud give (docs/results.md)."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scan import Scan
from ..xray import grid
from .asd_pocs import asd_pocs, check_parameters
from .sart import sart
from .system import Reconstruction, check_bound, check_counts


def refined(scan: Scan, niter: int = 20, completed_niter: int = 2, tviter: int = 20, alpha: float = 0.12,
            alpha_red: float = 0.87, rmax: float = 0.65, maxl2err: float = 0., exact_every: int = 5, subvoxel: float = 0.,
            seed: int = 0, *, completed: Scan, init, render, progress=None) -> Reconstruction:
    """SART on views completed from a cloud, then ASD-POCS on the measured ones alone.

    The cloud's views are wrong by little, but where the measured ones see nothing; so they are met first, and what they have
    wrong is put right by the measured ones. Total variation is smoothed away in long steps, which shorten until they change
    the volume by `rmax` of what the data do. Where Joseph's projector is off, the projections are corrected for it.

    Structure finer than the voxels, which all real objects have, this takes for density, and makes streaks of it. The cloud,
    which has no voxels, shows how much there is: its images less the projections of its volume. With `subvoxel` that share of
    it is taken out of all projections first. It costs as much of what voxels alone would resolve, so it is 0 for an object
    that was simulated on these very voxels, and 1 for others (docs/results.md, "Better volumes from 25 views").

    scan              measured projections and geometry
    niter             passes over the measured views
    completed_niter   passes over the completed views before
    tviter, alpha, alpha_red, rmax, maxl2err, exact_every
                      of `asd_pocs`. The defaults are for clean projections; with noise, maxl2err says how well to meet them
    subvoxel          from 0 to 1
    seed              of the random orders
    completed         measured views, which come first, and those between (`two_stage.filled`)
    init              the cloud's volume [x, y, z], density per mm
    render            the cloud's line integrals [view, v, u] of any views, a function of their geometry; for `subvoxel` alone
    progress          called as progress(passes done, passes, residual)

    The residuals are those of the measured views. Raises InputError as `asd_pocs` does.
    """
    check_counts(niter=niter, completed_niter=completed_niter)
    check_parameters(niter=niter, tviter=tviter, alpha=alpha, alpha_red=alpha_red, rmax=rmax, maxl2err=maxl2err,
                     exact_every=exact_every, seed=seed)  # before the passes
    check_bound('subvoxel', subvoxel, 1.)
    if subvoxel > 0:
        finer = np.float32(subvoxel) * (render(completed.geometry) - grid.project(init, completed.geometry))
        completed = replace(completed, projections=completed.projections - finer)
        scan = replace(scan, projections=scan.projections - finer[:len(scan)])
    passes = completed_niter + niter

    def of_stage(before):
        return progress and (lambda done, _, residual: progress(before + done, passes, residual))
    first = sart(completed, completed_niter, init=init, seed=seed, progress=of_stage(0))
    return asd_pocs(scan, niter, tviter=tviter, alpha=alpha, alpha_red=alpha_red, rmax=rmax, maxl2err=maxl2err,
                    exact_every=exact_every, init=first.volume, seed=seed, progress=of_stage(completed_niter))
