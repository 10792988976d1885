"""Voxel scaling for spatial occupancy (paper, section III-B). Pure NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lingo_mi.geometry.rays import Rays
from lingo_mi.lingo.masks import Masks
from lingo_mi.lingo.voxel_filter import valid_voxels


def occupancy(
    rays: Rays,
    masks: Masks,
    half: np.ndarray,
    shape: Sequence[int],
    resolution: int = 16,
    misses: int = 0,
    outside: str = 'invalid',
) -> float:
    """P = count(low valid cells of a coarse grid) / V^3, in [0, 1], with V = `resolution`.

    An axis with fewer than V voxels keeps them (a single slice stays one cell thick), and the count is
    divided by the actual number of cells. The other arguments are the same as for `valid_voxels`.
    """
    coarse = np.minimum(resolution, shape)
    low, _ = valid_voxels(rays, masks, coarse, half, misses, outside)
    return len(low) / float(np.prod(coarse))


def scale_factor(P: float, V_S: float = 20.0) -> float:
    """S = max(P V_S, 1)."""
    return max(P * V_S, 1.0)


def scaled_grid(shape: Sequence[int], S: float, smallest: int = 8) -> tuple[int, int, int]:
    """V_ds = V_d / S, rounded to whole cells, at least `smallest` (or all cells, if they are fewer)."""
    x, y, z = (max(int(n / S + 0.5), min(smallest, int(n))) for n in shape)
    return x, y, z
