"""A scan with a pose for every view."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.rays import Index, Rays, checked_views


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PosedGeometry(Geometry):
    """A scan with a pose for every view. `Geometry.from_poses` makes a `CircularGeometry` instead if it can.

    Its other numbers follow from the poses, for labels: DSO is the mean distance from the source to the volume's centre, DSD that
    to the panel's plane, dDetector the mean length of the steps, and `angles` are the directions to the source, seen from above.

    Parameters
    ----------
    poses : Rays
        Poses of all views, mm.
    nDetector, grid
        As in `Geometry`.

    Raises
    ------
    InputError
        For rays that make no view, see `Rays.checked`.

    Examples
    --------
    >>> from lingo_mi.geometry import Grid, scanner_rays
    >>> rays = scanner_rays([0.0, 1.5], 900, 1400, (20, 24), (1.0, 1.0), tilt=0.1)
    >>> PosedGeometry(poses=rays, nDetector=(20, 24), grid=Grid(64, 0.5)).mode
    'cone'
    """

    poses: Rays = field(repr=False)
    mode: str = field(init=False)
    dDetector: tuple[float, float] = field(init=False)
    angles: np.ndarray = field(init=False)
    DSO: float = field(init=False)
    DSD: float = field(init=False)

    def __post_init__(self):
        rays = self.poses.checked()
        step_v, step_u = (float(np.mean(np.linalg.norm(x, axis=1))) for x in (rays.v, rays.u))
        object.__setattr__(self, 'poses', rays)
        object.__setattr__(self, 'mode', 'parallel' if rays.parallel else 'cone')
        object.__setattr__(self, 'dDetector', (step_v, step_u))
        super().__post_init__()
        toward = -rays.source if rays.parallel else rays.source - np.asarray(self.grid.centre)
        object.__setattr__(self, 'angles', np.arctan2(toward[:, 1], toward[:, 0]))
        normal = np.cross(rays.u, rays.v)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        to_panel = rays.corner if rays.parallel else rays.corner - rays.source
        object.__setattr__(self, 'DSO', 0.0 if rays.parallel else float(np.mean(np.linalg.norm(toward, axis=1))))
        object.__setattr__(self, 'DSD', float(np.mean(np.abs(np.sum(to_panel * normal, 1)))))
        nearest = float(np.linalg.norm(toward, axis=1).min())
        self._require_proportions(nearest, self.DSO, self.DSD, np.abs(rays.corner).max())

    def rays(self, curved: bool = False) -> Rays:
        """The rays of all views in the world frame, mm: see `Geometry.rays`."""
        return self.poses

    def subset(self, index: Index) -> PosedGeometry:
        """The same scan with the views `index` only: a slice, or integers [m]."""
        return replace(self, poses=self.poses[checked_views(index, len(self))])

    def binned(self, factor: int) -> PosedGeometry:
        """The same rays with `factor` x `factor` pixels taken as one: see `Geometry.binned`."""
        by_v, by_u = self.bins(factor)
        nv, nu = self.nDetector
        poses = replace(self.poses, u=self.poses.u * by_u, v=self.poses.v * by_v)
        return replace(self, nDetector=(nv // by_v, nu // by_u), poses=poses)
