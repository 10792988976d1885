"""Total variation, also with another weight along a direction (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from numbers import Real
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.priors.differences import LARGEST, differences, length, transposed
from lingo_mi.reconstruction.priors.prior import Prior, check_positive, clipped


@dataclass
class TV(Prior):
    """Isotropic total variation: the sum of the lengths of the differences between neighbouring voxels.

    It suits objects of uniform parts. Voxels are treated as cubes.

    Parameters
    ----------
    inner : int
        Steps of the dual problem in a call, at least 1. A call continues from the dual variables of the previous one.

    Raises
    ------
    InputError
        For an option out of its range.

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
    volumes: ClassVar[float] = 9.0

    def __post_init__(self):
        check_counts(inner=self.inner)
        self.begin()

    def begin(self) -> None:
        self._dual: list[Any] | None = None

    def prox(self, x, strength, size, upper=inf):
        if strength <= 0:
            return super().prox(x, strength, size, upper)
        weight = dr.opaque(mi.Float, strength)
        scale = dr.opaque(mi.Float, 1 / (LARGEST * self._stretch**2 * strength))
        if self._dual is None or dr.width(self._dual[0]) != dr.width(x):
            self._dual = [dr.zeros(mi.Float, dr.width(x)) for _ in range(3)]

        def primal(q):
            z = clipped(dr.fma(-weight, transposed(self._turned(q), size), x), upper)
            dr.eval(z)
            return z

        p = q = self._dual
        t = 1.0
        for _ in range(self.inner):
            moved = [dr.fma(scale, d, c) for d, c in zip(self._turned(differences(primal(q), size)), q)]
            shorter = dr.rcp(dr.maximum(1, length(moved)))
            new = [c * shorter for c in moved]
            after = (1 + (1 + 4 * t * t) ** 0.5) / 2
            push = dr.opaque(mi.Float, (t - 1) / after)
            q = [dr.fma(push, b - a, b) for a, b in zip(p, new)]
            dr.eval(new, q)
            p, t = new, after
        self._dual = p
        return primal(p)

    _stretch = 1.0  # norm of `_turned`

    def _turned(self, d: list[Any]) -> list[Any]:
        """A symmetric map of the differences, whose lengths count."""
        return d


@dataclass
class DirectionalTV(TV):
    """Total variation whose differences along a direction count `weight` times, for limited arcs.

    A limited arc does not show edges to which no ray is tangent. Their normals are near the direction of the middle view. A
    weight above 1 along this direction removes the smear that the missing views leave there.

    Parameters
    ----------
    direction : sequence of float
        Direction from source to panel in the middle view of the arc: x, y and z of a vector of any length.
    weight : float
        Weight along the direction, above 0. A weight of 1 is `TV`.
    inner : int
        As for `TV`.

    Raises
    ------
    InputError
        For an option out of its range.

    References
    ----------
    Bayram and Kamasak, "Directional total variation", IEEE Signal Processing Letters 19 (2012); Chen, Jin, Li and Wang, "A
    limited-angle CT reconstruction method based on anisotropic TV minimization", Phys. Med. Biol. 58 (2013).

    Examples
    --------
    >>> DirectionalTV(direction=(0, 1, 0), weight=2.0).weight
    2.0
    """

    inner: int = 8
    direction: Sequence[float] = (1.0, 0.0, 0.0)
    weight: float = 2.0

    def __post_init__(self):
        super().__post_init__()
        check_positive('weight', self.weight)
        along = tuple(self.direction) if isinstance(self.direction, Sequence | np.ndarray) else ()
        numbers = len(along) == 3 and all(isinstance(c, Real) for c in along)
        size = float(np.linalg.norm(along)) if numbers else 0.0
        if not (np.isfinite(size) and size > 0):
            raise InputError(f'direction must be three numbers, not all zero, not {self.direction!r}')
        self._along = [float(c) / size for c in along]
        self._stretch = max(1.0, self.weight)

    def _turned(self, d):
        along = [dr.opaque(mi.Float, c) for c in self._along]
        more = dr.opaque(mi.Float, self.weight - 1) * sum(n * c for n, c in zip(along, d))
        return [dr.fma(more, n, c) for n, c in zip(along, d)]
