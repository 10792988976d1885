"""The content of pictures and pages about a volume and a history: slices, their places, their grey scale, curves. Pure
functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def plane(volume: np.ndarray, axis: int, index: int) -> np.ndarray:
    """The slice of a volume [x, y, z] across `axis` as an image [vertical, horizontal], lowest row first.

    With imshow(origin='lower') x points right and y up in the axial slice (axis 2), x right and z up in the
    coronal one (axis 1), y right and z up in the sagittal one (axis 0).
    """
    return np.take(volume, index, axis).T


def plane_extent(
    shape: Sequence[int], spacing: ArrayLike, centre: ArrayLike, axis: int
) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of a slice across `axis`, in mm: the outer edges of its voxels."""
    low, high = volume_bounds(shape, spacing, centre)
    a, b = (i for i in range(3) if i != axis)
    return low[a], high[a], low[b], high[b]


def volume_bounds(shape: Sequence[int], spacing: ArrayLike, centre: ArrayLike) -> Any:
    """The corners (low, high) of a volume, each [3], mm."""
    half, middle = np.array(shape) * np.asarray(spacing) / 2, np.asarray(centre)
    return middle - half, middle + half


def richest(volume: np.ndarray, axis: int) -> int:
    """The index along `axis` of the slice with the largest energy (sum of squares); the middle of a plateau."""
    energy = np.array([np.square(s, dtype=np.float64).sum() for s in np.moveaxis(volume, axis, 0)])
    best = np.flatnonzero(energy >= 0.999 * energy.max())
    return int(best[len(best) // 2])


def planes(shape: Sequence[int]) -> list[int]:
    """The axes across which slices are images, not lines. For a single-slice volume, only its thin axis."""
    return [axis for axis in (2, 1, 0) if min(n for i, n in enumerate(shape) if i != axis) > 1] or [2]


def series(history: list[dict], x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    """The points of a curve: the entries of `history` with finite numbers for both quantities."""
    points = [(float(h[x]), float(h[y])) for h in history if h.get(x) is not None and h.get(y) is not None]
    points = np.array(points, float).reshape(-1, 2)
    points = points[np.isfinite(points).all(1)]
    return points[:, 0], points[:, 1]
