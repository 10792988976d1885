"""The work of the constructors of `Geometry`: they choose the kind of scan for the given numbers."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, require_type, shown
from lingo_mi.geometry import limits
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.circle import CircularGeometry, circle_of, require_mode
from lingo_mi.geometry.grid import Grid, Voxels, grid_of
from lingo_mi.geometry.posed import PosedGeometry
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import helix, scanner_rays


def circle_or_poses(mode: str, scan: dict[str, Any], pitch: float = 0.0) -> Geometry:
    """The circle of the numbers `scan`, or what its motion makes of it if any of that is not zero."""
    motion = _taken(scan, ('rotDetector', 'COR', 'height', 'tilt'))
    circle = CircularGeometry(mode=mode, grid=grid_of(_taken(scan, Voxels.__annotations__)), **scan)
    _warn_of_degrees(circle.angles, helical=bool(pitch) or 'height' in motion)
    if pitch:
        climb, height = helix(circle.angles, pitch), limits.lengths('height', motion.get('height', 0.0))
        if height.shape not in ((), climb.shape):
            raise InputError(f'height must be one number, or one for each of {len(climb)} views, not {shown(height)}')
        motion['height'] = climb + height
    if not any(np.any(limits.numbers(name, value)) for name, value in motion.items()):
        return circle
    if 'rotDetector' in motion:
        motion['rotDetector'] = limits.vector('rotDetector', motion['rotDetector'], 3)
    return Geometry.per_view(**circle.numbers(), **motion)


def per_view(
    mode: str, DSO: ArrayLike, DSD: ArrayLike, nDetector: ArrayLike, dDetector: ArrayLike, views: dict[str, Any]
) -> Geometry:
    """The scan of `Geometry.per_view`."""
    require_mode(mode)
    voxels = _taken(views, Voxels.__annotations__)
    nDetector, dDetector = limits.counts('nDetector', nDetector, 2), limits.sizes('dDetector', dDetector, 2)
    DSO, DSD = limits.lengths('DSO', DSO), limits.lengths('DSD', DSD)
    origin = limits.lengths('offOrigin', voxels.get('offOrigin', 0.0))
    rays = scanner_rays(
        DSO=DSO, DSD=DSD, nDetector=nDetector, dDetector=dDetector, parallel=mode == 'parallel', **views
    )
    if mode == 'cone' and not (np.all(DSO > 0) and np.all(DSD >= DSO)):
        raise InputError('a cone beam needs DSD >= DSO > 0 in every view (both are distances from the source, in mm)')
    if origin.ndim == 2:
        if origin.shape != (len(rays), 3):
            raise InputError(
                f'offOrigin must be 3 numbers, or that for each of {len(rays)} views, not an array of shape {origin.shape}'
            )
        voxels['offOrigin'] = origin.mean(0)
        rays = rays.moved(shift=voxels['offOrigin'] - origin)
    return from_poses(rays, nDetector, grid_of(voxels))


def from_poses(rays: Rays, nDetector: Any, grid: Grid) -> Geometry:
    """The scan of `Geometry.from_poses`."""
    require_type('rays', rays, Rays, 'of an array [view, 4, 3] give Rays.from_vectors(array, parallel)')
    if rays.curve is not None:
        return _curved(rays, nDetector, grid)
    posed = PosedGeometry(poses=rays, nDetector=nDetector, grid=grid)
    circle = circle_of(posed.poses, posed.nDetector)
    if circle is None:
        return posed
    return CircularGeometry(mode=posed.mode, nDetector=posed.nDetector, grid=grid, **circle)


def _curved(rays, nDetector, grid):
    from lingo_mi.geometry.curved import CurvedGeometry  # which is made of a flat one

    radius = rays.curve.radius * np.linalg.norm(rays.u, axis=1)
    if np.ptp(radius) > 1e-6 * radius.mean():
        raise InputError('all views of a scan have one panel, and the radius of this one differs between views')
    return CurvedGeometry(flat=from_poses(replace(rays, curve=None), nDetector, grid), radius=float(radius[0]))


def source_shifted(geometry: Geometry, shift: ArrayLike) -> Geometry:
    """The scan of `Geometry.source_shifted`."""
    rays = geometry.rays()
    if rays.parallel:
        raise InputError('a parallel beam has no source to shift')
    shift = limits.lengths('shift', shift)
    if shift.shape not in ((3,), (len(rays), 3)):
        raise InputError(
            f'shift must be 3 numbers, or that for each of {len(rays)} views, not an array of shape {shift.shape}'
        )
    along, down = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (rays.u, rays.v))
    away = np.cross(along, down)
    away *= np.sign(np.sum(away * (rays.source - rays.corner), 1, keepdims=True))
    by_u, up, back = np.broadcast_to(shift, (len(rays), 3)).T[..., None]
    source = rays.source + by_u * along - up * down + back * away
    return from_poses(replace(rays, source=source), geometry.nDetector, geometry.grid)


def _taken(numbers: dict[str, Any], names) -> dict[str, Any]:
    """The numbers of these names, which are removed from `numbers`."""
    return {name: numbers.pop(name) for name in names if name in numbers}


def _warn_of_degrees(angles: np.ndarray, helical: bool) -> None:
    """Warn, in the name of the caller's caller's caller, if angles in radians look like degrees: they make more than four turns.

    A helix may, so its angles must be whole numbers for a warning.
    """
    turns = np.ptp(angles) / (2 * np.pi)
    if turns > 4 and not (helical and np.any(angles % 1)):
        warnings.warn(
            f'angles are radians, and these make {turns:.3g} turns, from {angles.min():g} to {angles.max():g}: '
            'if they are degrees, give numpy.radians(angles)',
            stacklevel=4,
        )
