"""A volume on voxels that starts from a cloud's own: the best that a few views and a fitted cloud give (docs/results.md)."""
from __future__ import annotations

from ..scan import Scan
from .asd_pocs import asd_pocs, check_parameters
from .sart import sart
from .system import Reconstruction, check_counts


def refined(scan: Scan, niter: int = 20, completed_niter: int = 2, tviter: int = 20, alpha: float = 0.12,
            alpha_red: float = 0.87, rmax: float = 0.65, maxl2err: float = 0., exact_every: int = 5, seed: int = 0, *,
            completed: Scan, init, progress=None) -> Reconstruction:
    """SART on views completed from a cloud, then ASD-POCS on the measured ones alone.

    The cloud's views are wrong by little, but where the measured ones see nothing; so they are met first, and what they have
    wrong is put right by the measured ones. Total variation is smoothed away in long steps, which shorten until they change
    the volume by `rmax` of what the data do. Where Joseph's projector is off, the projections are corrected for it.

    Of an object whose structure is finer than the voxels this makes streaks in the end: choose voxels as fine as the panel
    resolves, fewer passes, or `asd_pocs` of the completed views (docs/results.md, "The paper's two stages").

    scan              measured projections and geometry
    niter             passes over the measured views
    completed_niter   passes over the completed views before
    tviter, alpha, alpha_red, rmax, maxl2err, exact_every
                      of `asd_pocs`. The defaults are for clean projections; with noise, maxl2err says how well to meet them
    seed              of the random orders
    completed         measured views and those between (`two_stage.filled`)
    init              the cloud's volume [x, y, z], density per mm
    progress          called as progress(passes done, passes, residual)

    The residuals are those of the measured views. Raises InputError as `asd_pocs` does.
    """
    check_counts(niter=niter, completed_niter=completed_niter)
    check_parameters(niter=niter, tviter=tviter, alpha=alpha, alpha_red=alpha_red, rmax=rmax, maxl2err=maxl2err,
                     exact_every=exact_every, seed=seed)  # before the passes
    passes = completed_niter + niter

    def of_stage(before):
        return progress and (lambda done, _, residual: progress(before + done, passes, residual))
    first = sart(completed, completed_niter, init=init, seed=seed, progress=of_stage(0))
    return asd_pocs(scan, niter, tviter=tviter, alpha=alpha, alpha_red=alpha_red, rmax=rmax, maxl2err=maxl2err,
                    exact_every=exact_every, init=first.volume, seed=seed, progress=of_stage(completed_niter))
