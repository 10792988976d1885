"""ASD-POCS: SART steps towards the data, then steepest descent on total variation, in balance.

Sidky and Pan, "Image reconstruction in circular cone-beam computed tomography by constrained, total-variation
minimization", Phys. Med. Biol. 53 (2008), algorithm of section 2.3; the defaults of lmbda, lmbda_red, tviter, alpha,
alpha_red, rmax and blocksize are TIGRE's.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from lingo_mi.reconstruction.fdk import fdk
from lingo_mi.reconstruction.rectify import is_circular
from lingo_mi.reconstruction.sart import passes, sweep
from lingo_mi.reconstruction.system import (
    LARGE,
    Reconstruction,
    System,
    check_bound,
    check_counts,
    check_range,
    dot,
    evaluated,
    norm,
    scalar,
)
from lingo_mi.scan import Scan

EPSILON = 1e-8  # added to the squared gradient, relative to its largest value before a pass's descent: TV is not smooth at zero
LMBDA_MIN = 0.005


def _neighbours(size):
    """Flat indices of the voxels before and after every voxel along x, y, z; at the border the voxel itself."""
    nx, ny, nz = size
    index = dr.arange(mi.UInt, nx * ny * nz)
    line = index // nz
    x = line // ny
    position = x, line - x * ny, index - line * nz
    stride = ny * nz, nz, 1
    before = [index - dr.select(p > 0, mi.UInt(s), 0) for p, s in zip(position, stride)]
    after = [index + dr.select(p < n - 1, mi.UInt(s), 0) for p, n, s in zip(position, size, stride)]
    return before, after


def _differences(volume, before):
    """Backward differences along x, y, z; zero at the border."""
    return mi.Vector3f([volume - dr.gather(mi.Float, volume, i) for i in before])


def tv_floor(volume, size):
    """What `tv_gradient` adds to squared gradients, a number on the device: `EPSILON` of the largest in the volume."""
    before, _ = _neighbours(size)
    return evaluated(dr.maximum(EPSILON * dr.max(dr.squared_norm(_differences(volume, before))), 1e-30))


def tv_gradient(volume, size, floor):
    """Derivative of the total variation, mi.Float [voxels], times voxels' own unit.

    TV is the sum over the voxels of sqrt(dx^2 + dy^2 + dz^2 + floor), with backward differences that are zero at the
    border (Sidky and Pan, equation 3). Voxels count as cubes.
    """
    before, after = _neighbours(size)
    difference = _differences(volume, before)
    inverse = evaluated(dr.rsqrt(dr.squared_norm(difference) + floor))
    total = dr.sum(difference) * inverse
    for i in after:  # at the border the difference is zero
        total -= (dr.gather(mi.Float, volume, i) - volume) * dr.gather(mi.Float, inverse, i)
    return evaluated(total)


def minimise_tv(volume, size, step: float, tviter: int):
    """`tviter` steps of length `step` (a norm of the change) down the total variation."""
    floor = tv_floor(volume, size)
    for _ in range(tviter):
        gradient = tv_gradient(volume, size, floor)
        length = norm(gradient)
        if length == 0:
            break
        volume = evaluated(dr.fma(scalar(-step / length), gradient, volume))
    return volume


def check_parameters(
    *, niter, tviter, alpha, alpha_red, rmax, maxl2err, exact_every, seed, blocksize=1, lmbda=1.0, lmbda_red=1.0
):
    """Raises InputError for a parameter of `asd_pocs` out of its range."""
    check_counts(niter=niter, blocksize=blocksize, tviter=tviter)
    check_counts(least=0, exact_every=exact_every, seed=seed)
    for name, value, high in (
        ('lmbda', lmbda, 2),
        ('lmbda_red', lmbda_red, 1),
        ('alpha', alpha, LARGE),
        ('alpha_red', alpha_red, 1),
        ('rmax', rmax, LARGE),
    ):
        check_range(name, value, 0, high)
    if maxl2err is not None:
        check_bound('maxl2err', maxl2err)


def asd_pocs(
    scan: Scan,
    niter: int = 50,
    blocksize: int = 1,
    lmbda: float = 1.0,
    lmbda_red: float = 0.99,
    tviter: int = 20,
    alpha: float = 0.002,
    alpha_red: float = 0.95,
    rmax: float = 0.95,
    maxl2err: float | None = None,
    noneg: bool = True,
    OrderStrategy: str = 'random',
    exact_every: int = 0,
    init=None,
    weights=None,
    blur=None,
    seed: int = 0,
    progress=None,
) -> Reconstruction:
    """Adaptive steepest descent, projection onto convex sets.

    scan         projections and geometry
    niter        passes over all views, at most
    blocksize    views an update of the data step (1: SART, else OS-SART)
    lmbda        relaxation of the data step, 0 < lmbda <= 2; multiplied by `lmbda_red` after every pass
    tviter       steepest-descent steps on total variation a pass
    alpha        length of these steps over the change of the first data step
    alpha_red    factor on the step length where total variation changed more than `rmax` times what the data changed,
                 while the data are not met
    rmax         see `alpha_red`
    maxl2err     |A x - b| at which the data count as met, density times mm (default: 0.2 |A fdk(b) - b|; 0 for scans that FDK
                 does not know, so that the step shortens wherever total variation changes too much)
    noneg        whether negative densities are set to zero by the data step
    OrderStrategy
                 of the blocks, see `os_sart`
    exact_every  passes between corrections of the projections for what Joseph's projector is off (`System.correct`), before the
                 first pass and after every so many; 0 for none
    init         start volume [x, y, z], density per mm (default: zero)
    weights      of the voxels in the data step, see `os_sart`
    blur         of what a data step changes, see `os_sart`
    seed         of the random order
    progress     called as progress(passes done, niter, residual)

    Stops where the data are met and both steps undo each other (cosine below -0.99), or lmbda falls below 0.005. The
    volume is the one after descent, as TIGRE's; the residuals are those of the data steps before it.

    Raises InputError for a parameter out of its range, a start volume that does not fit, and where the result is not finite.
    """
    check_parameters(
        niter=niter,
        tviter=tviter,
        alpha=alpha,
        alpha_red=alpha_red,
        rmax=rmax,
        maxl2err=maxl2err,
        exact_every=exact_every,
        seed=seed,
        blocksize=blocksize,
        lmbda=lmbda,
        lmbda_red=lmbda_red,
    )
    order, size = passes(scan.geometry.angles, blocksize, OrderStrategy, seed), scan.geometry.nVoxel
    system = System(scan, weights, blur)
    x = system.start(init)
    if maxl2err is None:
        maxl2err = 0.2 * system.residual(system.start(fdk(scan)))[1] * system.size_b if is_circular(scan) else 0.0
    residuals = [system.residual(x)[1]]
    step = None
    for k in range(niter):
        if exact_every and k % exact_every == 0:
            system.correct(x)
        start = x
        x = sweep(system, x, lmbda, next(order), noneg)
        residuals.append(system.residual(x)[1])
        error = residuals[-1] * system.size_b
        data_change = evaluated(x - start)
        data_length = norm(data_change)
        if step is None:
            step = alpha * data_length
        start = x
        x = minimise_tv(x, size, step, tviter)
        tv_change = evaluated(x - start)
        tv_length = norm(tv_change)
        if tv_length > rmax * data_length and error > maxl2err:
            step *= alpha_red
        lmbda *= lmbda_red
        if progress:
            progress(k + 1, niter, residuals[-1])
        cosine = dot(data_change, tv_change) / max(data_length * tv_length, 1e-30)
        if (cosine < -0.99 and error <= maxl2err) or lmbda < LMBDA_MIN:
            break
    return Reconstruction(system.volume(x), residuals)
