"""The exact projector of `grid` and its transpose, for iterative algorithms: any poses, invalid pixels allowed (Dr.Jit).

`joseph` and `tilted_joseph` are faster (docs/benchmarks/speed.md says by how much), but do not serve a source beside the volume.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.bent import on_plane, tables
from lingo_mi.projectors.grid import gather, pixel_walk, scatter, view_table
from lingo_mi.projectors.stack import Block, Stack, Views
from lingo_mi.projectors.upload import uploaded


class GridPair(Stack):
    """The matrix A of a scan, with zero rows for invalid pixels. `adjoint` is its transpose to rounding.

    Parameters
    ----------
    valid : ndarray or None
        Bool [view, v, u]; None: all.
    """

    def __init__(self, geometry: Geometry, valid: np.ndarray | None = None):
        super().__init__(geometry, valid)
        self._rays = uploaded(view_table(geometry, curved=True))
        self._bend = tables(geometry.rays(curved=True).curve, self.panel[1])

    def of_slab(self, slab: Geometry) -> GridPair:
        """The matrix of the same scan for other slices of its voxels. slab: see `Geometry.slab`."""
        out = copy(self)
        out.geometry, out.size, out._rays = slab, slab.grid.shape, uploaded(view_table(slab, curved=True))
        return out

    def forward(self, volume: Any, views: Views) -> tuple[Any, Any]:
        """Line integrals of a volume in the views `views` (integers): (A x, A 1), each mi.Float [block, u, v].

        A 1 is the length of the ray inside the box, mm; zero for invalid pixels.
        """
        walk, length = self._walk(Block.of(views))
        return length * gather(volume, self.size, walk), length * dr.maximum(walk.t_last - walk.t_first, 0)

    def adjoint(self, images: Any, views: Views, rule: Callable[[Any, Any, Any], Any] | None = None) -> Any:
        """Backprojection A^T y of images of the views `views`, summed over these views: mi.Float [voxels].

        Parameters
        ----------
        images
            mi.Float [block, u, v].
        rule : callable or None
            Function of (voxel, A^T y, A^T 1), with flat indices mi.UInt and the sums; its result is returned instead.
        """
        walk, length = self._walk(Block.of(views))
        sums = [dr.zeros(mi.Float, self.voxels) for _ in range(1 if rule is None else 2)]
        for target, value in zip(sums, (dr.select(length > 0, images, 0), 1)):
            scatter(target, length * value, self.size, walk)
            dr.eval(target)
        return sums[0] if rule is None else rule(dr.arange(mi.UInt, self.voxels), *sums)

    def _walk(self, block):
        """The `Walk`s of the pixels of some views, and the length of a unit of t, in mm; zero for invalid pixels."""
        view, u, v = self.pixels_of(block)
        walk, length = pixel_walk(self.geometry, self._rays, *on_plane(self._bend, self.panel, view, u, v), view)
        return walk, dr.select(self.used(view, u, v), length, 0)
