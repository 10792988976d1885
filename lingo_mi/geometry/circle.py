"""A scan whose source moves on a circle, and a test whether poses are on one."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import limits
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.rays import Index, Rays, checked_views
from lingo_mi.geometry.trajectories import scanner_rays

SAME = 1e-3  # pixels by which a pose may miss a circle and still count as on it


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CircularGeometry(Geometry):
    """The source on a circle about z before an upright panel, rows down.

    Parameters
    ----------
    offDetector : [2]
        Shift of the panel, (v, u), mm, positive v up.
    **numbers
        The numbers of `Geometry`. DSO and DSD of a parallel beam only place its panel.

    Raises
    ------
    InputError
        For numbers that make no scan, among them a cone beam without DSD >= DSO > 0.

    Examples
    --------
    >>> from lingo_mi.geometry import Grid
    >>> panel = dict(nDetector=512, dDetector=1)
    >>> len(CircularGeometry(DSO=1000, DSD=1500, grid=Grid(256, 1.0), angles=[0.0, 1.5], **panel))
    2
    """

    mode: str = 'cone'
    offDetector: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        require_mode(self.mode)
        super().__post_init__()
        object.__setattr__(self, 'offDetector', limits.vector('offDetector', self.offDetector, 2))
        angles = np.atleast_1d(limits.angles('angles', self.angles))
        if angles.ndim != 1 or len(angles) == 0:
            raise InputError('the scan has no views: give at least one angle')
        object.__setattr__(self, 'angles', angles)
        for name in ('DSO', 'DSD'):
            value = limits.lengths(name, getattr(self, name))
            if value.ndim:
                raise InputError(f'{name} must be one number, in mm, not {shown(getattr(self, name))}')
            object.__setattr__(self, name, float(value))
        if self.mode == 'cone' and not self.DSD >= self.DSO > 0:
            raise InputError(
                f'a cone beam needs DSD >= DSO > 0, but DSO = {self.DSO:g} and DSD = {self.DSD:g} '
                '(both are distances from the source, in mm)'
            )
        self._require_proportions(self.DSO, self.DSO, self.DSD, *self.offDetector)

    def numbers(self) -> dict[str, Any]:
        """All numbers by name, as the class and `Geometry.per_view` take them."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def rays(self, curved: bool = False) -> Rays:
        """The rays of all views in the world frame, mm: see `Geometry.rays`."""
        return scanner_rays(
            self.angles,
            self.DSO,
            self.DSD,
            self.nDetector,
            self.dDetector,
            self.mode == 'parallel',
            offDetector=self.offDetector,
        )

    def subset(self, index: Index) -> CircularGeometry:
        """The same scan with the views `index` only: a slice, or integers [m]."""
        return replace(self, angles=self.angles[checked_views(index, len(self))])

    def joined(self, other: Geometry) -> Geometry:
        """The views of this scan, then the views of another: see `Geometry.joined`."""
        same = 'mode', 'DSO', 'DSD', 'nDetector', 'dDetector', 'offDetector'
        if isinstance(other, CircularGeometry) and all(getattr(self, name) == getattr(other, name) for name in same):
            return replace(self, angles=np.concatenate([self.angles, other.angles]))
        return super().joined(other)

    def binned(self, factor: int) -> CircularGeometry:
        """The same rays with `factor` x `factor` pixels taken as one: see `Geometry.binned`."""
        by = self.bins(factor)
        shape = tuple(n // f for n, f in zip(self.nDetector, by))
        step = tuple(d * f for d, f in zip(self.dDetector, by))
        # Dropped pixels at the end move the panel's centre: u grows with the column, z falls with the row.
        lost = [(n - m * f) / 2 * d for n, m, f, d in zip(self.nDetector, shape, by, self.dDetector)]
        offset = (self.offDetector[0] + lost[0], self.offDetector[1] - lost[1])
        return replace(self, nDetector=shape, dDetector=step, offDetector=offset)


def require_mode(mode: Any) -> None:
    """Raises InputError unless `mode` is the name of a kind of beam."""
    if not (isinstance(mode, str) and mode in ('cone', 'parallel')):
        raise InputError(f"mode must be 'cone' or 'parallel', not {shown(mode)}")


def circle_of(rays: Rays, nDetector: tuple[int, int]) -> dict[str, Any] | None:
    """DSO, DSD, dDetector, offDetector and angles of the circle that the poses are, None if they are not on one."""
    out = -rays.source if rays.parallel else rays.source
    angles = np.arctan2(out[:, 1], out[:, 0])
    c, s = np.cos(angles), np.sin(angles)
    centre = rays.centre(nDetector)
    DSO = 0.0 if rays.parallel else float(np.mean(np.hypot(out[:, 0], out[:, 1])))
    DSD = float(DSO - np.mean(centre[:, 0] * c + centre[:, 1] * s))
    step_v, step_u = (float(np.mean(np.linalg.norm(x, axis=1))) for x in (rays.v, rays.u))
    offset = (float(np.mean(centre[:, 2])), float(np.mean(centre[:, 1] * c - centre[:, 0] * s)))
    if not rays.parallel and not DSD >= DSO > 0:
        return None
    like = scanner_rays(angles, DSO, DSD, nDetector, (step_v, step_u), rays.parallel, offDetector=offset)
    # An error of the beam's direction grows with the distance.
    reach = np.linalg.norm(rays.corner, axis=1).max() if rays.parallel else 1
    allowed = SAME * min(step_v, step_u)
    near = all(
        np.abs(a - b).max() * size <= allowed
        for a, b, size in (
            (rays.source, like.source, reach),
            (rays.corner, like.corner, 1),
            (rays.u, like.u, nDetector[1]),
            (rays.v, like.v, nDetector[0]),
        )
    )
    if not near:
        return None
    return dict(DSO=DSO, DSD=DSD, angles=angles, dDetector=(step_v, step_u), offDetector=offset)
