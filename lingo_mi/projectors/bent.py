"""Pixels of curved panels as positions on the flat panels that they touch, on the device (Dr.Jit): see `geometry.curve`.

A ray through a pixel of a curved panel is the ray through (X, Y) of the flat one, so the projectors of voxels need no more. The
splat of Gaussians works along straight lines of equally spaced pixels, which are the columns of a curved panel (`Bend`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.geometry.curve import Curve
from lingo_mi.projectors.upload import uploaded

NUMBERS = 5  # of a view, see `Curve.numbers`


def tables(curve: Curve | None, columns: int) -> tuple[Any, Any]:
    """X and s of all columns, mi.Float [view * u * 2], and `Curve.numbers`, mi.Float [view * 5]; None for flat panels."""
    if curve is None:
        return None, None
    return uploaded(column_table(curve, columns)), uploaded(curve.numbers)


def column_table(curve: Curve, columns: int) -> np.ndarray:
    """X and s of the centres of all columns, float64 [view, u, 2]."""
    x = np.arange(columns) + 0.5
    return np.stack([curve.columns(x), 1 / curve.share(x)], -1)


def on_plane(tables: tuple[Any, Any], panel: tuple[int, int], view: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """(X, Y) of the centres of pixels, mi.Float; of a flat panel these are u + 1/2 and v + 1/2.

    Parameters
    ----------
    tables
        See the function `tables`.
    panel : tuple[int, int]
        Rows and columns.
    view, u, v
        mi.UInt.
    """
    if tables[0] is None:
        return mi.Float(u) + 0.5, mi.Float(v) + 0.5
    x, scale = column(tables[0], panel, view, u)
    foot = dr.gather(mi.Float, tables[1], view * NUMBERS + 3)
    return x, dr.fma(scale, (mi.Float(v) + 0.5) - foot, foot)


def column(table: Any, panel: tuple[int, int], view: Any, u: Any) -> tuple[Any, Any]:
    """X and s of columns u of views, from the first of `tables`."""
    entry = dr.gather(mi.Vector2f, table, view * panel[1] + u)
    return entry.x, entry.y


def numbers_of(table: Any, view: Any) -> list[Any]:
    """radius, middle, foot_u, foot_v and distance of a view, from the second of `tables`."""
    return [dr.gather(mi.Float, table, view * NUMBERS + i) for i in range(NUMBERS)]


def column_of(numbers: list[Any], x: Any) -> Any:
    """The column position on the curved panel of a position X on the flat one, as `Curve.on_panel` gives it.

    If the ray misses the cylinder, the end of its half circle.
    """
    radius, middle, foot, _, distance = numbers
    inv = 1 / distance
    r, p, q = radius * inv, (foot - middle) * inv, (x - middle) * inv
    a, b, c = dr.fma(q - p, q - p, 1), p * (q - p) - (1 - r), p * p + 1 - 2 * r
    root = dr.sqrt(dr.maximum(b * b - a * c, 0))
    k = dr.select(b < 0, (root - b) / a, -c / (b + root))
    return dr.fma(radius, dr.atan2(dr.fma(k, q - p, p), r - (1 - k)), middle)


@dataclass
class Bend:
    """Bend of the panel of one view.

    Parameters
    ----------
    table : Float64 [2 u]
        X and s of the centres of its columns.
    numbers : Float64 [6]
        `Curve.numbers`, and the largest s.
    """

    table: Any
    numbers: Any

    @staticmethod
    def of(curve: Curve, columns: int) -> Bend:
        """Make the bend for a curve of one view and a panel of so many columns."""
        table = column_table(curve, columns)
        largest = (1 / curve.share([0.0, columns])).max()
        return Bend(uploaded(table, double=True), uploaded(np.append(curve.numbers, largest), double=True))

    def column(self, u: Any, active: Any = True) -> tuple[Any, Any]:
        """X and s of columns u, Float64; 0 and 1 if they are not active."""
        scale = dr.gather(mi.Float64, self.table, 2 * u + 1, active)
        return dr.gather(mi.Float64, self.table, 2 * u, active), dr.select(active, scale, 1)

    def on_plane(self, u: Any, v: Any) -> tuple[Any, Any]:
        """(X, Y) of the centres of pixels, Float64."""
        x, scale = self.column(u)
        return x, self.foot + scale * (mi.Float64(v) + 0.5 - self.foot)

    def position(self, x: Any, y: Any) -> tuple[Any, Any]:
        """(X, Y) of any positions on the panel, Float64, as by `Curve.on_plane`."""
        radius, middle, foot_u, foot_v, distance = self._numbers()
        angle = (mi.Float64(x) - middle) / radius
        scale = distance / (distance - radius * (1 - dr.cos(angle)))
        return foot_u + scale * (middle + radius * dr.sin(angle) - foot_u), foot_v + scale * (mi.Float64(y) - foot_v)

    @property
    def foot(self) -> Any:
        """The row position of the source's foot."""
        return dr.gather(mi.Float64, self.numbers, mi.UInt32(3))

    def column_of(self, x: Any) -> Any:
        """The column position on the curved panel of a position X on the flat one."""
        return column_of(self._numbers(), x)

    def _numbers(self) -> list[Any]:
        return [dr.gather(mi.Float64, self.numbers, mi.UInt32(i)) for i in range(NUMBERS)]

    def rows_of(self, low: Any, high: Any) -> tuple[Any, Any]:
        """Row positions that hold those from low to high on the flat panel, in whichever column."""
        foot, least = self.foot, 1 / dr.gather(mi.Float64, self.numbers, mi.UInt32(NUMBERS))
        low, high = low - foot, high - foot
        return foot + dr.minimum(low, low * least), foot + dr.maximum(high, high * least)


def turned(image: Any, rows: int, columns: int) -> Any:
    """An image, Float [rows * columns], row by row, column by column instead."""
    i = dr.arange(mi.UInt32, rows * columns)
    height, width = dr.opaque(mi.UInt32, rows), dr.opaque(mi.UInt32, columns)
    return dr.gather(mi.Float, image, i % height * width + i // height, mode=dr.ReduceMode.Permute)
