r"""Pixels of a panel that is bent on a cylinder, as positions on the flat panel that it touches. Pure NumPy.

The columns of a curved panel are lines along the axis of its cylinder, evenly spaced along the arc. The panel touches a flat
one along its middle, with the same steps u and v there. A ray that meets the curved panel at the pixel position (x, y) meets the
flat one at (X, Y). Lengths are in columns, h is how far the curved panel stands before the flat one, R the radius, D the
distance of the source from the flat panel, and (f, g) the pixel position where the perpendicular from the source meets it:

.. math::

    a = (x - m) / R, \quad h = R (1 - \cos a), \quad s = D / (D - h)

    X = f + s (m + R \sin a - f), \quad Y = g + s (y - g)

For a cylinder about the focal spot, R = D and f = m, this is X = m + D tan a and Y = g + (y - g) / cos a. None of these numbers
changes if scanner and volume are moved, turned or scaled together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Curve:
    """The bends of n panels.

    Parameters
    ----------
    middle : float
        m, the position of the column where the curved panel touches the flat one.
    radius, foot_u, foot_v, distance : float64 [n]
        R, f, g and D, of each view, in columns but for g, in rows.
    """

    middle: float
    radius: np.ndarray
    foot_u: np.ndarray
    foot_v: np.ndarray
    distance: np.ndarray

    def __getitem__(self, index) -> Curve:
        """The bends of some views."""
        return Curve(self.middle, self.radius[index], self.foot_u[index], self.foot_v[index], self.distance[index])

    def cropped(self, x: float, y: float) -> Curve:
        """The bends of the part of the panels that begins at the pixel position x, y."""
        return Curve(self.middle - x, self.radius, self.foot_u - x, self.foot_v - y, self.distance)

    @property
    def numbers(self) -> np.ndarray:
        """radius, middle, foot_u, foot_v and distance of each view: float64 [n, 5]."""
        middle = np.full_like(self.radius, self.middle)
        return np.stack([self.radius, middle, self.foot_u, self.foot_v, self.distance], 1)

    def share(self, x: ArrayLike, view: int | slice = slice(None)) -> np.ndarray:
        """1 / s at column positions: the share of the way from the source to the flat panel at which the curved one stands.

        Of one view, or of all, which then are the first axis, with positions [m].
        """
        radius, distance = (_column(a[view]) for a in (self.radius, self.distance))
        return 1 - radius / distance * (1 - np.cos((np.asarray(x, float) - self.middle) / radius))

    def columns(self, x: ArrayLike, view: int | slice = slice(None)) -> np.ndarray:
        """X of column positions x, as for `share`."""
        x = np.asarray(x, float)
        radius, foot = _column(self.radius[view]), _column(self.foot_u[view])
        return foot + (self.middle + radius * np.sin((x - self.middle) / radius) - foot) / self.share(x, view)

    def on_plane(self, x: ArrayLike, y: ArrayLike, view: int) -> tuple[np.ndarray, np.ndarray]:
        """(X, Y) of pixel positions x, y of a view."""
        foot = self.foot_v[view]
        return self.columns(x, view), foot + (np.asarray(y, float) - foot) / self.share(x, view)

    def on_panel(self, x: ArrayLike, y: ArrayLike, view: int) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of `on_plane`, NaN if the ray does not meet the cylinder behind the source."""
        foot, distance = self.foot_u[view], self.distance[view]
        x, y = np.asarray(x, float), np.asarray(y, float)
        # In units of the distance, from the touching line: the source (p, 1), the flat panel (q, 0), the cylinder's axis (0, r).
        r, p, q = self.radius[view] / distance, (foot - self.middle) / distance, (x - self.middle) / distance
        # The ray (p, 1) + k (q - p, -1) meets the cylinder where  a k^2 + 2 b k + c = 0; the larger k is behind the source.
        a, b, c = (q - p) ** 2 + 1, p * (q - p) - (1 - r), p * p + 1 - 2 * r
        with np.errstate(invalid='ignore', divide='ignore'):
            root = np.sqrt(b * b - a * c)
            k = np.where(b < 0, (root - b) / a, -c / (b + root))
            k = np.where(k > 0, k, np.nan)
            angle = np.arctan2(p + k * (q - p), r - (1 - k))
            return self.middle + self.radius[view] * angle, self.foot_v[view] + (y - self.foot_v[view]) * k


def _column(a):
    """An array [n] as [n, 1], a number as it is."""
    return np.asarray(a)[..., None] if np.ndim(a) else a
