"""Differences between neighbouring voxels, and their transpose (Dr.Jit)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

LARGEST = 12.0  # a bound on |differences|^2 in three dimensions


def places(size: tuple[int, int, int]) -> tuple[Any, tuple[tuple[Any, Any, Any], ...]]:
    """Return the index of every voxel, and for each axis its place there, the number of voxels and the stride."""
    nx, ny, nz = (dr.opaque(mi.UInt32, n) for n in size)
    i = dr.arange(mi.UInt32, size[0] * size[1] * size[2])
    line = i // nz
    x = line // ny
    return i, ((x, nx, ny * nz), (line - x * ny, ny, nz), (i - line * nz, nz, mi.UInt32(1)))


def differences(z: Any, size: tuple[int, int, int]) -> list[Any]:
    """To the next voxel along each axis; 0 for the last one. z is evaluated."""
    i, axes = places(size)
    return [dr.select(at + 1 < n, dr.gather(mi.Float, z, i + step, at + 1 < n) - z, 0) for at, n, step in axes]


def transposed(p: list[Any], size: tuple[int, int, int]) -> Any:
    """The transpose of `differences`."""
    i, axes = places(size)
    total = mi.Float(0)
    for component, (at, n, step) in zip(p, axes):
        before = dr.gather(mi.Float, component, i - step, at > 0)
        total += dr.select(at > 0, before, 0) - dr.select(at + 1 < n, component, 0)
    return total


def length(d: list[Any]) -> Any:
    """The Euclidean norm of vectors, a component an entry."""
    return dr.sqrt(sum((c * c for c in d[1:]), d[0] * d[0]))
