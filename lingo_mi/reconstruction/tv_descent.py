"""Steepest descent on the total variation of a volume."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from lingo_mi.reconstruction.system import evaluated, norm, scalar

EPSILON = 1e-8  # added to squared gradients, relative to their largest value before a descent: TV is not smooth at zero


def _neighbours(size):
    """Flat indices of the voxels before and after every voxel along x, y, z; at the border the voxel itself."""
    nx, ny, nz = size
    index = dr.arange(mi.UInt, nx * ny * nz)
    line = index // nz
    x = line // ny
    position = x, line - x * ny, index - line * nz
    stride = ny * nz, nz, 1
    before = [index - dr.select(p > 0, mi.UInt(s), 0) for p, s in zip(position, stride)]
    after = [index + dr.select(p < n - 1, mi.UInt(s), 0) for p, n, s in zip(position, size, stride)]
    return before, after


def _differences(volume, before):
    """Backward differences along x, y, z; zero at the border."""
    return mi.Vector3f([volume - dr.gather(mi.Float, volume, i) for i in before])


def tv_floor(volume: mi.Float, size: tuple[int, int, int]) -> mi.Float:
    """The `floor` for `tv_gradient`, on the device: `EPSILON` times the largest squared gradient of the volume."""
    before, _ = _neighbours(size)
    return evaluated(dr.maximum(EPSILON * dr.max(dr.squared_norm(_differences(volume, before))), 1e-30))


def tv_gradient(volume: mi.Float, size: tuple[int, int, int], floor: mi.Float) -> mi.Float:
    """Derivative of the total variation, mi.Float [voxels], for voxels of side 1.

    TV is the sum over the voxels of sqrt(dx^2 + dy^2 + dz^2 + floor), with backward differences that are zero at the
    border (Sidky and Pan, equation 3). Voxels count as cubes.
    """
    before, after = _neighbours(size)
    difference = _differences(volume, before)
    inverse = evaluated(dr.rsqrt(dr.squared_norm(difference) + floor))
    total = dr.sum(difference) * inverse
    for i in after:  # at the border the difference is zero
        total -= (dr.gather(mi.Float, volume, i) - volume) * dr.gather(mi.Float, inverse, i)
    return evaluated(total)


def minimise_tv(volume: mi.Float, size: tuple[int, int, int], step: float, tviter: int) -> mi.Float:
    """`tviter` steps of length `step` (a norm of the change) down the total variation."""
    floor = tv_floor(volume, size)
    for _ in range(tviter):
        gradient = tv_gradient(volume, size, floor)
        length = norm(gradient)
        if length == 0:
            break
        volume = evaluated(dr.fma(scalar(-step / length), gradient, volume))
    return volume
