"""The interface of priors."""

from __future__ import annotations

from math import inf
from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.reconstruction.parameters import LARGE, check_range


class Prior:
    """Knowledge of a volume besides its projections: a function R of the volume, for `PenalisedLeastSquares`.

    To write a prior, derive from this class and define `prox`, or `gradient` and `curvature`, or all three if R is the sum of a
    smooth part and another one. This class itself is R = 0. Volumes are mi.Float [x * y * z], z fastest, densities per mm.

    Attributes
    ----------
    curvature : float
        A bound on the second derivatives of the smooth part, mm, or 0 without a smooth part.
    volumes : float
        Peak memory of `prox` and `gradient` besides their argument and result, in volumes. By it, a reconstruction refuses to
        start.

    Examples
    --------
    A quadratic penalty on the densities:

    >>> class Small(Prior):
    ...     curvature = 1.0
    ...     def gradient(self, x, size):
    ...         return x
    """

    curvature: float = 0.0
    volumes: float = 0.0

    def prox(self, x: mi.Float, strength: float, size: tuple[int, int, int], upper: float = inf) -> mi.Float:
        """The z in [0, upper] that minimises 1/2 |z - x|^2 + strength R(z), R without its smooth part.

        Parameters
        ----------
        x : mi.Float
            Densities, evaluated.
        strength : float
            Strength of the prior, at least 0.
        size : tuple of int
            Voxels along x, y and z.
        upper : float
            The largest density, 1/mm.

        Returns
        -------
        mi.Float
            Evaluated.
        """
        z = clipped(x, upper)
        dr.eval(z)
        return z

    def gradient(self, x: mi.Float, size: tuple[int, int, int]) -> mi.Float | None:
        """Return the gradient of the smooth part of R.

        Parameters
        ----------
        x : mi.Float
            Densities, evaluated.
        size : tuple of int
            Voxels along x, y and z.

        Returns
        -------
        mi.Float or None
            Of the size of x; None without a smooth part.
        """
        return None

    def begin(self) -> None:
        """Forget what earlier calls have left for the next one."""


def clipped(x: Any, upper: float) -> Any:
    """x within [0, upper]."""
    return dr.maximum(x, 0) if upper == inf else dr.clip(x, 0, dr.opaque(mi.Float, upper))


def check_positive(name: str, value: float) -> None:
    """Raises InputError for a number that is not above 0."""
    check_range(name, value, 0, LARGE)
