"""The panel's place in the scanner: shifts, of all views or of each, and a turn in its own plane. NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.geometry import CircularGeometry, Geometry


@dataclass(frozen=True)
class Panel:
    """Position of the real panel relative to the panel that a geometry describes.

    A shift along u is an axis of rotation off centre, and a yaw an axis that is not parallel to the columns.

        Panel(u=0.5).moved(scan.geometry).offDetector   # 0.5 mm more along u

    Parameters
    ----------
    v, u : array_like
        Mm, shifts along z and along the columns' direction, as in TIGRE's `offDetector`: one number, or one a view [n].
    yaw : float
        Radians, the turn in the panel's plane about its centre, as in TIGRE's `rotDetector`.
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
