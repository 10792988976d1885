"""Rotations of Gaussians: quaternions to matrix rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr


def rows_of(q: Any, Vector: Any) -> tuple:
    """The rows of the rotation matrix R of a quaternion (x, y, z, w), normalised here: three of the type `Vector`."""
    x, y, z, w = q
    twice = 2 / dr.squared_norm(q)
    tx, ty, tz = twice * x, twice * y, twice * z
    xx, yy, zz = x * tx, y * ty, z * tz
    xy, yz, zx = x * ty, y * tz, z * tx
    wx, wy, wz = w * tx, w * ty, w * tz
    return (
        Vector(1 - (yy + zz), xy - wz, zx + wy),
        Vector(xy + wz, 1 - (zz + xx), yz - wx),
        Vector(zx - wy, yz + wx, 1 - (xx + yy)),
    )


def rotate_inverse(rows: Sequence, v: Any) -> Any:
    """R^T v, from the rows of R."""
    return dr.fma(rows[2], v[2], dr.fma(rows[1], v[1], rows[0] * v[0]))
