"""Line integrals of a field along a scan's rays, by samples within the volume."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.grid import pixel_walk


@dataclass(frozen=True)
class FieldBox:
    """The cube that a field is encoded in, about the centre of a scan's volume; its box is the volume itself.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the scan.
    side : float
        Side of the cube, in units of the volume's longest side.
    """

    geometry: Geometry
    side: float

    def of_grid(self, position: Any) -> list:
        """Coordinates in the cube, in [0, 1], of a position in the scan's grid, where voxel centres are at whole numbers."""
        g, side = self.geometry, self.side * max(self.geometry.grid.size)
        return [
            dr.fma(position[i] + (0.5 - n / 2), dr.opaque(mi.Float, d / side), 0.5)
            for i, (n, d) in enumerate(zip(g.grid.shape, g.grid.spacing))
        ]


def integrals(
    density: Callable[[Sequence[Any]], Any], cube: FieldBox, row: Any, x: Any, y: Any, samples: int, within: Any
) -> Any:
    """Line integrals of a field along rays of one view, Float [rays], in units of the field's density times mm.

    With random positions the result is right on average (stratified sampling), with 1/2 it is the midpoint rule. A ray that
    misses the volume has the integral 0.

    Parameters
    ----------
    density : callable
        Density at points in the cube: three Float [N] in [0, 1].
    row
        Row of the view: one of `projectors.grid.view_table`, evaluated Float [19].
    x, y
        Pixel positions of the rays, Float [rays], centres at i + 1/2.
    samples : int
        On a ray, one in each of as many equal parts of its way through the volume.
    within
        Position of a sample in its part, from 0 to 1: Float [rays * samples], ray by ray, or a number.
    """
    walk, length = pixel_walk(cube.geometry, row, x, y)
    begin, step = walk.t_first, dr.maximum(walk.t_last - walk.t_first, 0) / samples
    dr.eval(walk.origin, walk.d, begin, step)
    index = dr.arange(mi.UInt32, samples * dr.width(x))
    ray = index // samples

    def of_ray(values: Any) -> Any:
        return dr.gather(type(values), values, ray)

    t = dr.fma(mi.Float(index - ray * samples) + within, of_ray(step), of_ray(begin))
    points = cube.of_grid(dr.fma(of_ray(walk.d), t, of_ray(walk.origin)))
    return dr.block_sum(density([dr.clip(p, 0, 1) for p in points]), samples) * step * length


def pixels_of(index: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the centres of pixels, by their flat indices in a view [v, u]: x along u, y along v."""
    return (index % columns + 0.5).astype(np.float32), (index // columns + 0.5).astype(np.float32)
