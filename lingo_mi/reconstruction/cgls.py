"""CGLS: conjugate gradients on the normal equations A^T A x = A^T b.

Björck, "Numerical Methods for Least Squares Problems", SIAM 1996, algorithm 7.4.1. It has no constraint, so densities may
be negative; few iterations regularise, many fit the noise.
"""

from __future__ import annotations

import drjit as dr

from lingo_mi.reconstruction.system import Reconstruction, System, check_bound, check_counts, dot, evaluated, scalar
from lingo_mi.scan import Scan


def cgls(scan: Scan, niter: int = 20, init=None, tol: float = 0.0, progress=None) -> Reconstruction:
    """Least squares by conjugate gradients.

    scan       projections and geometry
    niter      iterations, one projection and one backprojection of all views each
    init       start volume [x, y, z], density per mm (default: zero)
    tol        stop when |A x - b| / |b| is no larger
    progress   called as progress(iterations done, niter, residual)

    Stops early where the gradient A^T (b - A x) has vanished to rounding. Raises InputError for a parameter out of its range,
    a start volume that does not fit, and where the result is not finite.
    """
    check_counts(niter=niter)
    check_bound('tol', tol)
    system = System(scan)
    A, views = system.A, system.views
    x = system.start(init)
    r, residual = system.residual(x)
    p = evaluated(A.adjoint(r, views))
    gamma = first = dot(p, p)
    residuals = [residual]
    for k in range(niter):
        if residuals[-1] <= tol or gamma <= 1e-13 * first:
            break
        q = evaluated(A.forward(p, views)[0])
        alpha = scalar(gamma / dot(q, q))
        x, r = dr.fma(alpha, p, x), dr.fma(-alpha, q, r)
        dr.eval(x, r)
        s = evaluated(A.adjoint(r, views))
        gamma, before = dot(s, s), gamma
        p = evaluated(dr.fma(scalar(gamma / before), p, s))
        residuals.append(system.relative(r))
        if progress:
            progress(k + 1, niter, residuals[-1])
    return Reconstruction(system.volume(x), residuals)
