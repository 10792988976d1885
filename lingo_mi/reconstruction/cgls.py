"""CGLS: conjugate gradients on the normal equations A^T A x = A^T b."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
from numpy.typing import ArrayLike

from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.parameters import check_bound, check_counts
from lingo_mi.reconstruction.system import System, dot, evaluated, scalar
from lingo_mi.scan import Scan

VANISHED = 1e-13  # squared gradient, relative to the first one, that is rounding error in float32


@dataclass(frozen=True)
class CGLS(Algorithm):
    """Least squares by conjugate gradients: each iteration minimises |A x - b| over one more direction.

    With the residual r = b - A x, its gradient s = A^T r and the direction p, s at first,

        x <- x + a p,  r <- r - a A p,  a = |s|^2 / |A p|^2,        p <- s + (|s|^2 / |s before|^2) p

    It stops early when the gradient is zero to rounding. Use it for many views, or for a plain least-squares solution. It has
    no constraints: densities may be negative, and late iterations fit the noise.

    Björck, "Numerical Methods for Least Squares Problems", SIAM 1996, algorithm 7.4.1.

    Parameters
    ----------
    niter : int
        Iterations, at least 1; each takes one projection and one backprojection of all views.
    tol : float
        Stop when |A x - b| / |b| <= tol; at least 0.

    Raises
    ------
    InputError
        For an option out of its range.

    Examples
    --------
    >>> import lingo_mi as lm
    >>> from lingo_mi.phantoms import make, x3d_scan
    >>> measured = x3d_scan.scan(make('foot', 24), views=40, pixels=48).train
    >>> lm.reconstruct(measured, lm.CGLS(niter=10), progress=False).residuals[-1] < 0.05
    True
    """

    name: ClassVar[str] = 'cgls'

    niter: int = 20
    tol: float = 0.0

    def __post_init__(self):
        check_counts(niter=self.niter)
        check_bound('tol', self.tol)

    def _run(self, scan: Scan, *, start: ArrayLike | None = None, progress: Progress | None = None) -> Reconstruction:
        """Reconstruct the volume of a scan, see `run_algorithm`."""
        began = time.perf_counter()
        system = System(scan)
        A, views = system.A, system.views
        x = system.start(start)
        r, residual = system.residual(x)
        p = evaluated(A.adjoint(r, views))
        gamma = first = dot(p, p)
        residuals = [residual]
        for k in range(self.niter):
            if residuals[-1] <= self.tol or gamma <= VANISHED * first:
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
                progress(k + 1, self.niter, residuals[-1])
        return Reconstruction(system.volume(x), residuals, time.perf_counter() - began, scan.geometry.grid)
