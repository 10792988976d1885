"""The geometry of frames, from a file or a `Geometry`, checked against the frames, and of a part of the panel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files import scanner_dict
from lingo_mi.files.geometry_file import load_yaml, posed_geometry, rows_run_up
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry, Grid
from lingo_mi.geometry.curved import slid
from lingo_mi.raw.bruker import read_skyscan_log
from lingo_mi.raw.nikon import read_numbers, read_xtekct
from lingo_mi.raw.nsi import read_nsipro
from lingo_mi.raw.options import Options
from lingo_mi.raw.phoenix import read_pca
from lingo_mi.raw.recording import Recording, Taken

# Files that say where a scanner took its frames, but for voxels, by suffix.
SCANNER_FILES: dict[str, Callable[[Path], Taken]] = {
    '.xtekct': read_xtekct,  # Nikon
    '.nsipro': read_nsipro,  # North Star Imaging
    '.log': read_skyscan_log,  # Bruker
    '.pca': read_pca,  # GE, Waygate
}
GEOMETRY_FILES = ', '.join(('.yml', *SCANNER_FILES, '.xml (RTK)'))


def has_grid(geometry: PathLike | str | Geometry | None) -> bool:
    """Return whether a geometry gives the number of voxels. If not, `grid_in_view` makes the grid."""
    if isinstance(geometry, Geometry):
        return True
    if geometry is None or Path(geometry).suffix.lower() not in ('.yml', '.yaml'):
        return False
    return load_yaml(geometry).get('nVoxel') is not None


def _same(nDetector, shape):
    """Return whether a geometry file's nDetector, two numbers or one for both, is this shape."""
    try:
        return np.array_equal(np.broadcast_to(nDetector, 2), shape)
    except ValueError:  # of another length, or lists of several
        return False


def geometry_of(
    source: PathLike | str | Geometry | None, options: Options, recording: Recording
) -> tuple[Geometry, float | None, tuple[int, int]]:
    """The geometry of whole frames, the white level of their scanner, and the steps (1 or -1) that put rows and columns in its
    order.

    Parameters
    ----------
    source : path-like or Geometry or None
        As `geometry` of `import_raw`.

    Raises
    ------
    InputError
        If it does not agree with the frames, or is incomplete.
    """
    frames, angles = recording.views, recording.angles
    if options.angles is not None:
        listed = isinstance(options.angles, str | PathLike)
        try:
            angles = read_numbers(options.angles) if listed else np.atleast_1d(np.asarray(options.angles, float))
        except InputError:
            raise
        except (TypeError, ValueError):
            raise InputError('angles must be a list of numbers, in degrees, or the name of a file of them') from None
    if angles is not None and not np.isfinite(angles).all():
        raise InputError(
            f'{frames.where}: angle {int(np.argmin(np.isfinite(angles)))} is not a finite number; give angles=FILE'
        )
    if angles is not None and len(angles) != len(frames):
        raise InputError(f'{frames.where}: there are {len(angles)} angles for {len(frames)} views; these must agree')
    if isinstance(source, Geometry):
        _require_shape(source, frames, 'the geometry')
        return source, None, (1, 1)
    voxels: dict[str, Any] = dict(nVoxel=[frames.shape[1], frames.shape[1], frames.shape[0]], dVoxel=1.0)
    if source is None:
        if recording.taken is None:
            raise InputError(
                f'{frames.where}: does not say where its frames were taken; give geometry=FILE ({GEOMETRY_FILES})'
            )
        return _taken(recording.taken(), frames.where, options, angles, frames, voxels)
    path = Path(source)
    suffix = path.suffix.lower()
    if suffix == '.xml':
        if options.pixel is None:
            raise InputError(f"{path}: RTK's geometry does not say the size of a pixel; give pixel=MM")
        geometry = Geometry.from_rtk(path, nDetector=frames.shape, dDetector=options.pixel, **voxels)
        _require_shape(geometry, frames, path)
        return geometry, None, (-1, 1)
    if suffix in SCANNER_FILES:
        return _taken(SCANNER_FILES[suffix](path), path, options, angles, frames, voxels)
    if suffix not in ('.yml', '.yaml'):
        raise InputError(f'{path}: is not a geometry file; give {GEOMETRY_FILES}')
    values = load_yaml(path)
    for name, wrong in dict(valid=True, I0=True, input=values.get('input') == 'intensity').items():
        if wrong and values.get(name) is not None:
            raise InputError(
                f'{path}: {name} describes projections, not raw frames; take it out, and give flats=FILE, i0=COUNTS '
                'or air=(v0, v1, u0, u1)'
            )
    if values.get('nVoxel') is None:
        for name in 'dVoxel', 'sVoxel':
            if values.get(name) is not None:
                raise InputError(f'{path}: {name} needs nVoxel, the number of voxels; add it, or take {name} out')
        values |= voxels
    _complete(values, path, options, angles, frames)
    return posed_geometry(values, len(frames), path), None, (-1 if rows_run_up(values) else 1, 1)


def _require_shape(geometry, frames, what):
    if (len(geometry), *geometry.nDetector) != (len(frames), *frames.shape):
        raise InputError(
            f'{frames.where}: {len(frames)} frames of {frames.shape} pixels, but {what} has {len(geometry)} views of '
            f'{geometry.nDetector}; these must agree'
        )


def _complete(values, where, options, angles, frames):
    """Add the panel and the angles of the frames to a geometry file's values."""
    values.setdefault('nDetector', list(frames.shape))
    if not _same(values['nDetector'], frames.shape):
        raise InputError(
            f'{where}: nDetector is {values["nDetector"]}, but the frames have {list(frames.shape)} pixels (v, u)'
        )
    free = all(values.get(name) is None for name in ('angles', 'totalAngle', 'poses'))
    if angles is not None and (options.angles is not None or free):
        values['angles'] = np.asarray(angles).tolist()
    elif free:
        raise InputError(
            f'{where}: no angles: neither here nor with the frames; add angles or totalAngle, or give angles=FILE'
        )


def _taken(taken, where, options, angles, frames, voxels):
    """`geometry_of` for what a scanner's own file says."""
    steps = taken.rows, taken.columns
    if isinstance(taken.scanner, Geometry):
        if options.angles is not None:
            raise InputError(f'{where}: says the poses of all views; leave out angles, or give geometry=FILE')
        _require_shape(taken.scanner, frames, where)
        return taken.scanner, taken.white, steps
    values = taken.scanner | voxels
    _complete(values, where, options, angles, frames)
    if len(values['angles']) != len(frames):
        raise InputError(
            f'{where}: describes {len(values["angles"])} views, but there are {len(frames)} frames; these must agree'
        )
    return scanner_dict.to_geometry(values, np.radians(values['angles']), where), taken.white, steps


def cropped(geometry: Geometry, crop: tuple[int, int, int, int]) -> Geometry:
    """The geometry of the pixels (v0, v1, u0, u1) alone."""
    v0, v1, u0, u1 = crop
    (nv, nu), pixels = geometry.nDetector, (v1 - v0, u1 - u0)
    if pixels == (nv, nu):
        return geometry
    if isinstance(geometry, CircularGeometry):
        (dv, du), (v, u) = geometry.dDetector, geometry.offDetector
        offset = (v - ((v0 + v1) / 2 - nv / 2) * dv, u + ((u0 + u1) / 2 - nu / 2) * du)
        return replace(geometry, nDetector=pixels, offDetector=offset)
    curved = isinstance(geometry, CurvedGeometry)
    rays = geometry.flat.rays() if curved else geometry.rays()
    left = (nu - pixels[1]) / 2 if curved else u0  # an arc keeps its middle here, which then moves along it
    rays = replace(rays, corner=rays.corner + left * rays.u + v0 * rays.v)
    if not curved:
        return Geometry.from_poses(rays, pixels, grid=geometry.grid)
    along = (u0 - left) * np.linalg.norm(rays.u, axis=1)
    flat = Geometry.from_poses(slid(rays, pixels, geometry.radius, along), pixels, grid=geometry.grid)
    return CurvedGeometry(flat=flat, radius=geometry.radius)


def grid_in_view(geometry: Geometry) -> Geometry:
    """Voxels as large as a pixel on the axis, around it, as far as the panel sees; without an offOrigin as high as its rows."""
    (nv, nu), step = geometry.nDetector, geometry.dDetector[1]
    if geometry.mode == 'cone':
        step *= geometry.DSO / geometry.DSD
    rays = geometry.rays(curved=True)
    x, y = np.array([0.0, 0, nu, nu]), np.array([0.0, nv, 0, nv])
    if rays.curve is not None:  # where the corners of the arc are on the flat panels of `rays`
        foot = rays.curve.foot_v[:, None]
        x, y = rays.curve.columns(x), foot + (y - foot) / rays.curve.share(x)
    across = np.cross(rays.u, rays.v)
    corners = np.stack(
        [rays.corner + a[..., None] * rays.u + b[..., None] * rays.v for a, b in zip(x.T, y.T)]
    )  # [4, n, 3]
    start, along = (corners, rays.source) if rays.parallel else (rays.source, corners - rays.source)
    # Where they meet the plane through the origin that is parallel to the panel.
    seen = start - along * ((start * across).sum(-1) / (along * across).sum(-1))[..., None]
    low, high = seen[..., 2].min(), seen[..., 2].max()
    side, height = (max(1, int(np.ceil(x / step - 1e-6))) for x in (2 * np.hypot(*seen[..., :2].T).max(), high - low))
    middle = geometry.grid.centre if any(geometry.grid.centre) else (0.0, 0.0, (low + high) / 2)
    return geometry.on(Grid((side, side, height), (step,) * 3, middle))
