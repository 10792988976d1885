"""Pixels wider than voxels: voxels that rays miss, and the pattern that rays leave in a volume.

Rays go to pixel centres, and a projector's weights reach one voxel to either side of a ray. If pixels at the axis are two or
more voxels wide, some voxels are crossed by no ray of any view.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.geometry.base import Geometry

LEAST = 0.1  # a voxel counts as crossed if A^T 1 is above this share of its neighbourhood's mean


def pitch(geometry: Geometry) -> tuple[float, float, float]:
    """The distance between rays at the axis, in voxels (x, y, z): between columns along x and y, between rows along z."""
    at_axis = geometry.DSO / geometry.DSD if geometry.mode == 'cone' else 1.0
    v, u = (at_axis * d for d in geometry.dDetector)
    x, y, z = geometry.grid.spacing
    return u / x, u / y, v / z


def leave_voxels_out(geometry: Geometry) -> bool:
    """Return whether rays are so far apart that voxels lie between them."""
    return max(pitch(geometry)) >= 2


def excess_width(geometry: Geometry) -> tuple[float, float, float]:
    """Standard deviations (x, y, z), in voxels, of the `blur` for `sart`: a Gaussian that widens voxels to pixels at the axis.

    Variances add up; a box has width^2 / 12. It is doubled, since a pixel's width enters with A and with A^T. Zero if
    pixels are not wider than voxels.
    """
    x, y, z = (sqrt(max(p**2 - 1, 0) / 6) for p in pitch(geometry))
    return x, y, z


class Between:
    """Voxels that no ray crosses, or few rays at a corner, among neighbours that rays cross.

    Few small steps leave these voxels behind their neighbours. Outside the field of view (less than half of the neighbourhood
    crossed) nothing counts as between.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the scan.
    A, views
        Its projector and views.
    """

    @classmethod
    def of(cls, geometry: Geometry, A: Any, views: np.ndarray) -> Between | None:
        """None if rays are too close for such voxels."""
        return cls(geometry, A, views) if leave_voxels_out(geometry) else None

    def __init__(self, geometry: Geometry, A: Any, views: np.ndarray):
        self.size, self.deviations = geometry.grid.shape, tuple(p / 2 for p in pitch(geometry))
        weight = A.adjoint(dr.ones(mi.Float, len(views) * A.pixels), views)
        self.crossed = weight > LEAST * blurred(weight, self.size, self.deviations)
        share = blurred(dr.select(self.crossed, mi.Float(1), 0), self.size, self.deviations)
        self.share = dr.select(
            self.crossed | (share < 0.5), 0, share
        )  # crossed part of the neighbourhood of a voxel between rays; 0 for other voxels
        dr.eval(self.crossed, self.share)

    def filled(self, change: mi.Float) -> mi.Float:
        """A change of the volume (mi.Float [voxels]) in which voxels between rays change like their neighbours."""
        around = blurred(dr.select(self.crossed, change, 0), self.size, self.deviations)
        return dr.select(self.share > 0, around / self.share, change)


def blurred(volume: mi.Float, size: tuple[int, int, int], deviations: Sequence[float]) -> mi.Float:
    """A volume (mi.Float [voxels]) convolved with a Gaussian of these standard deviations, in voxels along x, y, z.

    Cut off at 4 standard deviations; the volume is mirrored at its borders. No deviation exceeds the volume's own side.
    """
    tensor = mi.TensorXf(volume, size)
    for axis, (deviation, count) in enumerate(zip(deviations, size)):
        if deviation > 0:
            s = min(deviation, count)
            tensor = dr.convolve(
                tensor, lambda x, s=s: exp(-0.5 * (x / s) ** 2), 4 * s, axis=axis, boundary='reflect', normalize=True
            )
    return tensor.array
