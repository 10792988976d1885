r"""The blur of a focal spot, and of a pixel's aperture: quadrature over rays (Dr.Jit).

The signal of a pixel is the mean intensity over all rays from a point of the focal spot F to a point of the pixel A,

    I(x) = 1 / (|F| |A|)  \int_F \int_A  I(s + f, x + a)  da df

For a uniform rectangle the Gauss-Legendre rule of n x n points integrates polynomials of degree 2 n - 1, so the error
falls exponentially with n where intensities are smooth; at an edge the blur is a staircase of n steps. Every pair of
points is a separate projection, with source and pixels moved, so that blur varies correctly with depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.view import View

MOST_ORDER = 16


@dataclass(frozen=True)
class FocalSpot:
    """size: width and height in mm, along u and v. order: n, for n x n points, 1 to 16."""

    size: tuple[float, float] = (0.0, 0.0)
    order: int = 3

    @staticmethod
    def of(size: Any, order: Any) -> FocalSpot:
        """From plugin parameters: '1.2, 0.8' or one number. Raises InputError."""
        try:
            numbers = [float(x) for x in str(size).replace(',', ' ').split()]
        except ValueError:
            numbers = []
        if len(numbers) not in (1, 2) or not all(np.isfinite(x) and x >= 0 for x in numbers):
            raise InputError(f'focal_spot must be one or two lengths in mm, not {size!r}')
        return FocalSpot((numbers[0], numbers[-1]), checked_order(order, 'focal_order'))

    def views(self, view: View) -> list:
        """(weight, View) of every point of the focal spot; the view itself for a point source."""
        if self.size == (0.0, 0.0):
            return [(1.0, view)]
        u, v = dr.normalize(view.u), dr.normalize(view.v)
        return [
            (weight, replace(view, source=view.source + _opaque(x * self.size[0]) * u + _opaque(y * self.size[1]) * v))
            for weight, x, y in square(self.order, *(s > 0 for s in self.size))
        ]

    def scaled(self, factor: float) -> FocalSpot:
        """The same spot with lengths multiplied by `factor`."""
        return replace(self, size=(factor * self.size[0], factor * self.size[1]))

    def check(self, distance: float | None) -> None:
        """Raises InputError unless the spot is smaller than its distance to the axis, mm (None: a parallel beam)."""
        if max(self.size) > 0 and distance is None:
            raise InputError('focal_spot: a parallel beam has no focal spot')
        if distance is not None and max(self.size) >= distance:
            raise InputError(
                f'focal_spot of {max(self.size):g} mm is not smaller than the distance of the source, {distance:g} mm'
            )

    def __str__(self):
        return f'focal_spot = {self.size[0]:g} x {self.size[1]:g} mm, {self.order} x {self.order} points'


def aperture_views(view: View, share: float, order: int) -> list:
    """(weight, View) of n x n points in the middle `share` of every pixel; the view itself for a share of 0."""
    if share == 0:
        return [(1.0, view)]
    return [
        (weight, replace(view, corner=view.corner + _opaque(x * share) * view.u + _opaque(y * share) * view.v))
        for weight, x, y in square(order)
    ]


def square(order: int, wide: bool = True, high: bool = True) -> list:
    """(weight, x, y) of the Gauss-Legendre rule on [-1/2, 1/2]^2, or along one of its axes; the weights sum to 1."""
    x, w = np.polynomial.legendre.leggauss(order)
    line, point = list(zip(w / 2, x / 2)), [(1.0, 0.0)]
    across, down = line if wide else point, line if high else point
    return [(float(wx * wy), float(x), float(y)) for wy, y in down for wx, x in across]


def checked_order(order: Any, name: str) -> int:
    """Raises InputError unless the number of quadrature points is an integer from 1 to 16."""
    if isinstance(order, bool) or not isinstance(order, int) or not 1 <= order <= MOST_ORDER:
        raise InputError(f'{name} must be a whole number from 1 to {MOST_ORDER}, not {order!r}')
    return order


def _opaque(x: float):
    """An opaque number: a literal would be compiled into a kernel for each point."""
    return dr.opaque(dr.value_t(mi.Vector3d), x)
