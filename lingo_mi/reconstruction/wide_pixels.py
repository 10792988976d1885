"""Pixels wider than voxels: rays that leave voxels between them out, and their pattern in a volume.

Rays go to pixels' centres, and a projector's weights reach one voxel to either side of a ray. Where pixels at the axis are
two voxels wide or more, some voxels are crossed by no ray of any view.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.geometry.base import Geometry

LEAST = 0.1  # A^T 1 over its mean around a voxel, above which rays count as crossing it


def pitch(geometry: Geometry) -> tuple[float, float, float]:
    """The distance between rays at the axis, (x, y, z) voxels: columns are as far apart along x and y, rows along z."""
    at_axis = geometry.DSO / geometry.DSD if geometry.mode == 'cone' else 1.0
    v, u = (at_axis * d for d in geometry.dDetector)
    x, y, z = geometry.dVoxel
    return u / x, u / y, v / z


def leave_voxels_out(geometry: Geometry) -> bool:
    """Whether rays are so far apart that voxels lie between them."""
    return max(pitch(geometry)) >= 2


def excess_width(geometry: Geometry) -> tuple[float, float, float]:
    """The Gaussian that makes voxels as wide as pixels at the axis, twice, as `blur` for `sart`: deviations (x, y, z), voxels.

    Variances add up, and that of a box is a twelfth of its width's square; twice, since a pixel's width comes in with A and
    with A^T. Zero where pixels are no wider than voxels.
    """
    x, y, z = (sqrt(max(p**2 - 1, 0) / 6) for p in pitch(geometry))
    return x, y, z


class Between:
    """The voxels between rays, crossed by none, or by few at a corner, among voxels that rays do cross.

    geometry   of the scan
    A, views   its projector and views

    Few and small steps leave such a voxel behind those around it, which meet the projections without it. Beyond the rays, where
    less than half of what is around a voxel is crossed, nothing counts as between.
    """

    @classmethod
    def of(cls, geometry: Geometry, A: Any, views: np.ndarray) -> Between | None:
        """None where rays are too close for there to be any."""
        return cls(geometry, A, views) if leave_voxels_out(geometry) else None

    def __init__(self, geometry: Geometry, A: Any, views: np.ndarray):
        self.size, self.deviations = geometry.nVoxel, tuple(p / 2 for p in pitch(geometry))
        weight = A.adjoint(dr.ones(mi.Float, len(views) * A.pixels), views)
        self.crossed = weight > LEAST * blurred(weight, self.size, self.deviations)
        share = blurred(dr.select(self.crossed, mi.Float(1), 0), self.size, self.deviations)
        self.share = dr.select(
            self.crossed | (share < 0.5), 0, share
        )  # of what rays cross around a voxel between them, 0 elsewhere
        dr.eval(self.crossed, self.share)

    def filled(self, change: mi.Float) -> mi.Float:
        """A change of the volume (mi.Float [voxels]), the voxels between rays changed as those around them."""
        around = blurred(dr.select(self.crossed, change, 0), self.size, self.deviations)
        return dr.select(self.share > 0, around / self.share, change)


def blurred(volume: mi.Float, size: tuple[int, int, int], deviations: Sequence[float]) -> mi.Float:
    """A volume (mi.Float [voxels]) convolved with a Gaussian of these standard deviations, in voxels along x, y, z.

    Cut off at 4 of them; beyond the border the volume is mirrored. Deviations above the volume's own side count as that.
    """
    tensor = mi.TensorXf(volume, size)
    for axis, (deviation, count) in enumerate(zip(deviations, size)):
        if deviation > 0:
            s = min(deviation, count)
            tensor = dr.convolve(
                tensor, lambda x, s=s: exp(-0.5 * (x / s) ** 2), 4 * s, axis=axis, boundary='reflect', normalize=True
            )
    return tensor.array
