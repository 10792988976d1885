"""Total generalised variation of second order (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from lingo_mi.reconstruction.parameters import check_counts
from lingo_mi.reconstruction.priors.differences import differences, length, places, transposed
from lingo_mi.reconstruction.priors.prior import Prior, check_positive, clipped

STEP = 1 / 4  # of primal and dual; 16 is a bound on |(differences z - v, slopes of v)|^2
HALF = 0.5**0.5
PAIRS = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)


@dataclass
class TGV(Prior):
    """Total generalised variation of second order: the least of |differences - v| + second |symmetric derivative of v| over v.

    A slope costs nothing, and an edge costs as much as in `TV`. It suits objects whose density varies smoothly within parts.
    Voxels are treated as cubes.

    Parameters
    ----------
    second : float
        Weight of the second derivative, above 0.
    inner : int
        Steps of the primal-dual method in a call, at least 1. A call continues from the variables of the previous one.

    Raises
    ------
    InputError
        For an option out of its range.

    References
    ----------
    Bredies, Kunisch and Pock, "Total generalized variation", SIAM J. Imaging Sci. 3 (2010); Chambolle and Pock, "A first-order
    primal-dual algorithm for convex problems with applications to imaging", J. Math. Imaging Vis. 40 (2011).

    Examples
    --------
    >>> TGV().second
    2.0
    """

    second: float = 2.0
    inner: int = 10
    volumes: ClassVar[float] = 36.0

    def __post_init__(self):
        check_counts(inner=self.inner)
        check_positive('second', self.second)
        self.begin()

    def begin(self) -> None:
        self._state: tuple[list[Any], list[Any], list[Any]] | None = None

    def prox(self, x, strength, size, upper=inf):
        if strength <= 0:
            return super().prox(x, strength, size, upper)
        state = self._state
        if state is None or dr.width(state[0][0]) != dr.width(x):
            state = [dr.zeros(mi.Float, dr.width(x)) for _ in range(12)]
            state = state[:3], state[3:6], state[6:]
        first, second = (dr.opaque(mi.Float, w) for w in (strength, strength * self.second))
        v, p, q = state
        z = x_bar = clipped(x - transposed(p, size), upper)
        v_bar = v
        dr.eval(z)
        for _ in range(self.inner):
            p = _within(first, [dr.fma(STEP, d - w, c) for d, w, c in zip(differences(x_bar, size), v_bar, p)])
            q = _within(second, [dr.fma(STEP, d, c) for d, c in zip(_slopes(v_bar, size), q)])
            dr.eval(p, q)
            new = clipped((z - STEP * transposed(p, size) + STEP * x) / (1 + STEP), upper)
            moved = [a - STEP * (b - c) for a, b, c in zip(v, _slopes_transposed(q, size), p)]
            moved = [dr.select(exists, a, 0) for a, exists in zip(moved, _edges(size))]
            x_bar, v_bar = 2 * new - z, [2 * a - b for a, b in zip(moved, v)]
            dr.eval(new, moved, x_bar, v_bar)
            z, v = new, moved
        self._state = v, p, q
        return z


def _within(bound: Any, p: list[Any]) -> list[Any]:
    shorter = bound / dr.maximum(bound, length(p))
    return [c * shorter for c in p]


def _edges(size):
    """Return the masks of voxels that have a next voxel along each axis."""
    return [at + 1 < n for at, n, _ in places(size)[1]]


def _masks(size):
    """Return, by (a, c), whether the derivative of component c along axis a has both of its ends."""
    axes, edges = places(size)[1], _edges(size)
    return {
        (a, c): edges[c] & ((axes[a][0] + 2 if a == c else axes[a][0] + 1) < axes[a][1])
        for a in range(3)
        for c in range(3)
    }


def _slopes(v, size):
    """The symmetric derivative of a field, as xx, yy, zz and the root of two times xy, xz, yz, so that its length is the norm."""
    masks = _masks(size)
    d = [differences(c, size) for c in v]
    part = {(a, c): dr.select(masks[a, c], d[c][a], 0) for a, c in masks}
    return [part[a, a] if a == c else HALF * (part[a, c] + part[c, a]) for a, c in PAIRS]


def _slopes_transposed(q, size):
    """The transpose of `_slopes`. q is evaluated."""
    masks, parts = _masks(size), {}
    for value, (a, c) in zip(q, PAIRS):
        parts[a, c] = parts[c, a] = value if a == c else HALF * value
    masked = {key: dr.select(masks[key], parts[key], 0) for key in masks}
    dr.eval(list(masked.values()))
    return [transposed([masked[a, c] for a in range(3)], size) for c in range(3)]
