"""The panel's place in the scanner: shifts, of all views or of each, and a turn in its own plane. NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class Panel:
    """How the real panel lies relative to the one that a geometry names.

    v, u   mm, shifts along z and along the columns' direction, as in TIGRE's `offDetector`: one number, or one a view [n]
    yaw    radians, the turn in the panel's plane about its centre, as in TIGRE's `rotDetector`

    A shift along u is an axis of rotation off centre, and a yaw an axis that is not parallel to the columns.

        Panel(u=0.5).moved(scan.geometry).offDetector   # 0.5 mm more along u
    """

    v: ArrayLike = 0.0
    u: ArrayLike = 0.0
    yaw: float = 0.0

    def moved(self, geometry: Geometry) -> Geometry:
        """The geometry with the panel where it really is. A circular one stays circular if all views move alike, without yaw."""
        if isinstance(geometry, CircularGeometry) and not self.yaw and not np.ndim(self.v) and not np.ndim(self.u):
            v, u = geometry.offDetector
            return replace(geometry, offDetector=(v + float(self.v), u + float(self.u)))  # type: ignore[arg-type]
        rays, (nv, nu) = geometry.rays(), geometry.nDetector
        step_v, step_u = (np.linalg.norm(x, axis=1, keepdims=True) for x in (rays.v, rays.u))
        along, down = rays.u / step_u, rays.v / step_v
        by_v, by_u = (np.broadcast_to(x, len(geometry))[:, None] for x in (self.v, self.u))
        centre = rays.centre(geometry.nDetector) + by_u * along - by_v * down
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        # Rx of TIGRE's frame (towards the source, u, up) turns u towards up, and down is -up.
        u, v = step_u * (c * along - s * down), step_v * (s * along + c * down)
        turned = replace(rays, corner=centre - nu / 2 * u - nv / 2 * v, u=u, v=v)
        return Geometry.from_poses(turned, geometry.nDetector, grid=geometry.grid)

    def resampled(self, scan: Scan) -> Scan:
        """What the panel of the scan's geometry would have seen, had it been where that says: by cubic splines.

        Pixels beyond the real panel's edge are not valid. The projections should hold no detail of single pixels, which
        interpolation would smooth.
        """
        geometry = scan.geometry
        (nv, nu), (dv, du) = geometry.nDetector, geometry.dDetector
        y, x = np.meshgrid((np.arange(nv) - (nv - 1) / 2) * dv, (np.arange(nu) - (nu - 1) / 2) * du, indexing='ij')
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        p, valid = np.empty_like(scan.projections), np.empty(scan.projections.shape, bool)
        for i, (v, u) in enumerate(zip(*(np.broadcast_to(k, len(scan)) for k in (self.v, self.u)))):
            # Where the named pixels are on the real panel, in its steps; y points down, against v.
            down, across = y + v, x - u
            rows, columns = (s * across + c * down) / dv + (nv - 1) / 2, (c * across - s * down) / du + (nu - 1) / 2
            place = np.stack([rows, columns])
            p[i] = ndimage.map_coordinates(scan.projections[i], place, order=3, mode='nearest')
            valid[i] = (rows > -0.5) & (rows < nv - 0.5) & (columns > -0.5) & (columns < nu - 0.5)
            if scan.valid is not None:
                valid[i] &= ndimage.map_coordinates(scan.valid[i].astype(float), place, order=1, mode='nearest') > 0.99
        return replace(scan, projections=p, valid=valid)
