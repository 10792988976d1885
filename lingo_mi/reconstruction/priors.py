"""What is known of a volume besides its projections: priors, for `PenalisedLeastSquares` (Dr.Jit)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError
from lingo_mi.projectors.upload import uploaded
from lingo_mi.reconstruction.parameters import check_counts

DUAL = 1 / 12  # step of the dual of total variation, the reciprocal of a bound on |gradient|^2 in three dimensions


class Prior(ABC):
    """What is known of a volume: a function R of it, by its proximal map.

    A kind of your own derives from this class and defines `prox`.
    """

    @abstractmethod
    def prox(self, x: mi.Float, strength: float, size: tuple[int, int, int], upper: float = inf) -> mi.Float:
        """The z in [0, upper] with the least 1/2 |z - x|^2 + strength R(z).

        Parameters
        ----------
        x : mi.Float
            Densities [x, y, z], flat and evaluated.
        strength : float
            Of the prior, 1/mm, at least 0.
        size : tuple of int
            Voxels along x, y and z.
        upper : float
            The largest density.
        """

    def begin(self) -> None:  # noqa: B027 - most keep nothing
        """Forget what earlier calls have left for the next one."""


@dataclass
class TV(Prior):
    """Isotropic total variation: the sum of the lengths of the differences between neighbouring voxels.

    Parameters
    ----------
    inner : int
        Steps of the dual problem in a call, at least 1. A call goes on from the dual variables of the one before.

    References
    ----------
    Beck and Teboulle, "Fast gradient-based algorithms for constrained total variation image denoising and deblurring problems",
    IEEE TIP 18 (2009). The bounds on the densities are part of the problem.

    Examples
    --------
    >>> TV().inner
    8
    """

    inner: int = 8

    def __post_init__(self):
        check_counts(inner=self.inner)
        self.begin()

    def begin(self) -> None:
        self._dual: list[Any] | None = None

    def prox(self, x, strength, size, upper=inf):
        if strength <= 0:
            return _clipped(x, upper)
        weight, scale = dr.opaque(mi.Float, strength), dr.opaque(mi.Float, DUAL / strength)
        if self._dual is None or dr.width(self._dual[0]) != dr.width(x):
            self._dual = [dr.zeros(mi.Float, dr.width(x)) for _ in range(3)]
        p = q = self._dual
        t = 1.0
        for _ in range(self.inner):
            z = _clipped(dr.fma(-weight, _transposed(q, size), x), upper)
            dr.eval(z)
            moved = [dr.fma(scale, d, c) for d, c in zip(_differences(z, size), q)]
            shorter = dr.rcp(dr.maximum(1, dr.sqrt(moved[0] ** 2 + moved[1] ** 2 + moved[2] ** 2)))
            new = [c * shorter for c in moved]
            after = (1 + (1 + 4 * t * t) ** 0.5) / 2
            push = dr.opaque(mi.Float, (t - 1) / after)
            q = [dr.fma(push, b - a, b) for a, b in zip(p, new)]
            dr.eval(new, q)
            p, t = new, after
        self._dual = p
        z = _clipped(dr.fma(-weight, _transposed(p, size), x), upper)
        dr.eval(z)
        return z


@dataclass
class Denoiser(Prior):
    """A denoiser in the place of a proximal map (plug and play).

    Parameters
    ----------
    function : callable
        Called as function(volume, strength) with float32 [x, y, z], densities per mm, and a number in 1/mm that says how much to
        smooth; returns an array of the same shape.

    References
    ----------
    Venkatakrishnan, Bouman and Wohlberg, "Plug-and-play priors for model based reconstruction", GlobalSIP 2013.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> Denoiser(lambda volume, strength: gaussian_filter(volume, 0.5)).function(np.ones((2, 2, 2)), 0.1).shape
    (2, 2, 2)
    """

    function: Callable[[np.ndarray, float], Any]

    def __post_init__(self):
        if not callable(self.function):
            raise InputError(
                f'a denoiser is called as function(volume, strength), but {self.function!r} cannot be called'
            )

    def prox(self, x, strength, size, upper=inf):
        volume = as_numpy(self.function(x.numpy().reshape(size), strength), 'what the denoiser returns', np.float32)
        if volume.shape != size:
            raise InputError(f'the denoiser returns the shape {volume.shape} for a volume of the shape {size}')
        if not np.isfinite(volume).all():
            raise InputError('the denoiser returns NaN or infinity')
        z = _clipped(uploaded(volume), upper)
        dr.eval(z)
        return z


def _clipped(x, upper):
    return dr.maximum(x, 0) if upper == inf else dr.clip(x, 0, dr.opaque(mi.Float, upper))


def _places(size):
    """Of all voxels: index, and for each axis its place there, the number of voxels and the stride."""
    nx, ny, nz = (dr.opaque(mi.UInt32, n) for n in size)
    i = dr.arange(mi.UInt32, size[0] * size[1] * size[2])
    line = i // nz
    x = line // ny
    return i, ((x, nx, ny * nz), (line - x * ny, ny, nz), (i - line * nz, nz, mi.UInt32(1)))


def _differences(z, size):
    """To the next voxel along each axis; 0 for the last one."""
    i, axes = _places(size)
    return [dr.select(at + 1 < n, dr.gather(mi.Float, z, i + step, at + 1 < n) - z, 0) for at, n, step in axes]


def _transposed(p, size):
    """The transpose of `_differences`."""
    i, axes = _places(size)
    total = mi.Float(0)
    for component, (at, n, step) in zip(p, axes):
        before = dr.gather(mi.Float, component, i - step, at > 0)
        total += dr.select(at > 0, before, 0) - dr.select(at + 1 < n, component, 0)
    return total
