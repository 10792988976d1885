"""SART, OS-SART and SIRT: one update rule, taken a view, a block of views, or all views at a time.

Andersen and Kak, "Simultaneous algebraic reconstruction technique", Ultrasonic Imaging 6 (1984). For the rows A_b of a
block,

    x  <-  x + lmbda (A_b^T W (b - A_b x)) / (A_b^T 1),    W = 1 / (A_b 1)

where division is by voxel and by pixel, and what no ray meets is left alone. With weights s of the voxels these are the
same steps for z in x = x_0 + diag(s) z, A diag(s) in A's place:

    x  <-  x + lmbda s (A_b^T W (b - A_b x)) / (A_b^T 1),  W = 1 / (A_b s)

so that of all volumes that meet the projections the one is approached whose change is least, measured in s.

Pixels wider than the voxels see little of what is as fine as these, and steps for them leave the rays' own pattern. A `blur` G,
a Gaussian, smooths what a pass P of these steps has changed:

    x  <-  max(x + G (P(x) - x), 0)

It leaves alone what P leaves alone, so that what is approached in the end still meets the projections. Voxels between rays
that are met by hardly any change as those around them (`wide_pixels.Between`).

Parameters that TIGRE has carry its names for Python; lmbda, lmbda_red, blocksize and noneg have its defaults, OrderStrategy
that of TIGRE for MATLAB.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.reconstruction.system import (
    Reconstruction,
    System,
    check_bound,
    check_counts,
    check_range,
    evaluated,
    scalar,
)
from lingo_mi.reconstruction.wide_pixels import blurred
from lingo_mi.scan import Scan

ORDERS = ('ordered', 'random', 'angularDistance')


def blocks(angles, blocksize: int, order: str, rng) -> list[np.ndarray]:
    """The views [block][views of it] of one pass: blocks of consecutive views, in one of three orders.

    order   'ordered'; 'random'; or 'angularDistance', which takes next the block that is farthest from all before (the most
            distant on the circle, by the blocks' middle views)

    Raises InputError for an unknown order.
    """
    parts = [np.arange(i, min(i + blocksize, len(angles))) for i in range(0, len(angles), blocksize)]
    if order == 'ordered':
        return parts
    if order == 'random':
        return [parts[i] for i in rng.permutation(len(parts))]
    if order != 'angularDistance':
        raise InputError(f'OrderStrategy {order!r} is unknown: use one of {", ".join(ORDERS)}')
    middle = np.array([angles[p[len(p) // 2]] for p in parts])
    nearest, out = np.full(len(parts), np.inf), [0]
    while len(out) < len(parts):
        nearest = np.minimum(nearest, 1 - np.cos(middle - middle[out[-1]]))
        nearest[out[-1]] = -1
        out.append(int(np.argmax(nearest)))
    return [parts[i] for i in out]


def passes(angles, blocksize: int, order: str, seed: int):
    """The `blocks` of one pass after another, without end. Raises InputError for an unknown order, before any of them."""
    rng = np.random.default_rng(seed)

    def drawn():
        return blocks(angles, blocksize, order, rng)

    drawn()  # for its error alone
    return iter(drawn, None)


def sweep(system: System, x, lmbda: float, parts, noneg: bool):
    """One pass over all blocks: the new volume, on the device."""
    A, step, start = system.A, scalar(lmbda), x
    for views in parts:
        ax, path = A.forward(x, views)
        if system.weights is not None:
            path = A.select(system.weighed, views)
        error = A.select(system.b, views) - ax
        error = evaluated(dr.select(path > 0, error * dr.rcp(dr.maximum(path, 1e-30)), 0))

        def updated(voxel, change, weight, x=x):
            change = dr.select(weight > 0, change * dr.rcp(dr.maximum(weight, 1e-30)), 0)
            if system.weights is not None:
                change *= dr.gather(mi.Float, system.weights, voxel)
            value = dr.fma(step, change, dr.gather(mi.Float, x, voxel))
            return dr.maximum(value, 0) if noneg else value

        x = evaluated(A.adjoint(error, views, updated))
    if system.between is None and system.blur is None:
        return x
    change = x - start
    if system.between is not None:
        change = system.between.filled(change)
    if system.blur is not None:
        change = blurred(change, system.geometry.nVoxel, system.blur)
    return evaluated(dr.maximum(start + change, 0) if noneg else start + change)


def os_sart(
    scan: Scan,
    niter: int = 50,
    blocksize: int = 20,
    lmbda: float = 1.0,
    lmbda_red: float = 0.99,
    noneg: bool = True,
    OrderStrategy: str = 'random',
    init=None,
    weights=None,
    blur=None,
    tol: float = 0.0,
    seed: int = 0,
    progress=None,
) -> Reconstruction:
    """Ordered-subset SART.

    scan            projections and geometry
    niter           passes over all views
    blocksize       views an update
    lmbda           relaxation, 0 < lmbda <= 2; multiplied by `lmbda_red` after every pass
    noneg           whether negative densities are set to zero after every update
    OrderStrategy   of the blocks: 'ordered', 'random' (drawn anew every pass) or 'angularDistance', see `blocks`
    init            start volume [x, y, z], density per mm (default: zero)
    weights         of the voxels [x, y, z], from zero on: how readily each changes beside the others (default: all alike)
    blur            of what a pass changes: standard deviations in voxels along x, y, z (default: none)
    tol             stop when |A x - b| / |b| is no larger
    seed            of the random order
    progress        called as progress(passes done, niter, residual)

    Raises InputError for a parameter out of its range, a start volume that does not fit, and where the result is not finite.
    """
    check_counts(niter=niter, blocksize=blocksize)
    check_counts(least=0, seed=seed)
    check_range('lmbda', lmbda, 0, 2)
    check_range('lmbda_red', lmbda_red, 0, 1)
    check_bound('tol', tol)
    order = passes(scan.geometry.angles, blocksize, OrderStrategy, seed)
    system = System(scan, weights, blur)
    x = system.start(init)
    residuals = [system.residual(x)[1]]
    for k in range(niter):
        if residuals[-1] <= tol:
            break
        x = sweep(system, x, lmbda * lmbda_red**k, next(order), noneg)
        residuals.append(system.residual(x)[1])
        if progress:
            progress(k + 1, niter, residuals[-1])
    return Reconstruction(system.volume(x), residuals)


def sart(
    scan: Scan,
    niter: int = 20,
    lmbda: float = 1.0,
    lmbda_red: float = 0.99,
    noneg: bool = True,
    OrderStrategy: str = 'random',
    init=None,
    weights=None,
    blur=None,
    tol: float = 0.0,
    seed: int = 0,
    progress=None,
) -> Reconstruction:
    """SART: an update after every view. Parameters as in `os_sart`."""
    return os_sart(scan, niter, 1, lmbda, lmbda_red, noneg, OrderStrategy, init, weights, blur, tol, seed, progress)


def sirt(
    scan: Scan,
    niter: int = 100,
    lmbda: float = 1.0,
    lmbda_red: float = 0.99,
    noneg: bool = True,
    init=None,
    weights=None,
    blur=None,
    tol: float = 0.0,
    progress=None,
) -> Reconstruction:
    """SIRT: one update from all views. Parameters as in `os_sart`."""
    return os_sart(
        scan, niter, len(scan), lmbda, lmbda_red, noneg, 'ordered', init, weights, blur, tol, progress=progress
    )
