"""Where frames were taken: a geometry file, or a `Geometry`, checked against the frames, and that of a part of the panel."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files import scanner_dict
from lingo_mi.files.scans import load_yaml, posed_geometry, rows_run_up
from lingo_mi.geometry import CircularGeometry, Geometry, Grid
from lingo_mi.raw.frames import Frames
from lingo_mi.raw.nikon import read_numbers, read_xtekct
from lingo_mi.raw.options import Options


def grid_given(geometry: PathLike | str | Geometry) -> bool:
    """Whether it says how many voxels there are; else they are those of `grid_in_view`."""
    if isinstance(geometry, Geometry):
        return True
    suffix = Path(geometry).suffix.lower()
    return suffix in ('.yml', '.yaml') and load_yaml(geometry).get('nVoxel') is not None


def _same(nDetector, shape):
    """Whether a geometry file's nDetector, two numbers or one for both, is this shape."""
    try:
        return np.array_equal(np.broadcast_to(nDetector, 2), shape)
    except ValueError:  # of another length, or lists of several
        return False


def geometry_of(
    source: PathLike | str | Geometry, options: Options, recorded: np.ndarray | None, frames: Frames
) -> tuple[Geometry, float | None, tuple[int, int]]:
    """The geometry of whole frames, Nikon's white level, and the steps (1 or -1) that put rows and columns in its order.

    Parameters
    ----------
    source : path-like or Geometry
        As `geometry` of `import_raw`.
    recorded : ndarray or None
        Angles that the frames came with, [n] degrees.

    Raises
    ------
    InputError
        If the two do not agree, or the geometry is incomplete.
    """
    n, shape = len(frames), frames.shape
    angles = recorded
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
    if angles is not None and len(angles) != n:
        raise InputError(f'{frames.where}: there are {len(angles)} angles for {n} views; these must agree')
    if isinstance(source, Geometry):
        if (len(source), *source.nDetector) != (n, *shape):
            raise InputError(
                f'{frames.where}: {n} frames of {shape} pixels, but the geometry has {len(source)} views of {source.nDetector}'
            )
        return source, None, (1, 1)
    path = Path(source)
    suffix = path.suffix.lower()
    grid: dict[str, Any] = dict(nVoxel=[shape[1], shape[1], shape[0]], dVoxel=1.0)
    if suffix == '.xml':
        if options.pixel is None:
            raise InputError(f"{path}: RTK's geometry says no size of pixels; give pixel=MM")
        found = Geometry.from_rtk(path, nDetector=shape, dDetector=options.pixel, **grid)
        if len(found) != n:
            raise InputError(f'{path}: describes {len(found)} views, but there are {n} frames; these must agree')
        return found, None, (-1, 1)
    white, nikon = None, suffix == '.xtekct'
    if nikon:
        values, white = read_xtekct(path)
    elif suffix in ('.yml', '.yaml'):
        values = load_yaml(path)
        for name, wrong in dict(valid=True, I0=True, input=values.get('input') == 'intensity').items():
            if wrong and values.get(name) is not None:
                raise InputError(
                    f'{path}: {name} describes projections, not raw frames; take it out, and give flats=FILE, i0=COUNTS '
                    'or air=(v0, v1, u0, u1)'
                )
    else:
        raise InputError(f'{path}: is not a geometry file; give .yml, .xtekct or .xml (RTK)')
    values.setdefault('nDetector', list(shape))
    if not _same(values['nDetector'], shape):
        raise InputError(f'{path}: nDetector is {values["nDetector"]}, but the frames have {list(shape)} pixels (v, u)')
    if values.get('nVoxel') is None:
        for name in 'dVoxel', 'sVoxel':
            if values.get(name) is not None:
                raise InputError(f'{path}: {name} needs nVoxel, the number of voxels; add it, or take {name} out')
        values |= grid
    free = all(values.get(name) is None for name in ('angles', 'totalAngle', 'poses'))
    if angles is not None and (options.angles is not None or free):
        values['angles'] = np.asarray(angles).tolist()
    elif free:
        raise InputError(
            f'{path}: no angles: neither here nor with the frames; add angles or totalAngle, or give angles=FILE'
        )
    if nikon:
        if len(values['angles']) != n:
            raise InputError(
                f'{path}: describes {len(values["angles"])} views, but there are {n} frames; these must agree'
            )
        return scanner_dict.to_geometry(values, np.radians(values['angles']), path), white or None, (1, -1)
    return posed_geometry(values, n, path), None, (-1 if rows_run_up(values) else 1, 1)


def cropped(geometry: Geometry, crop: tuple[int, int, int, int]) -> Geometry:
    """The geometry of the pixels (v0, v1, u0, u1) alone."""
    v0, v1, u0, u1 = crop
    if isinstance(geometry, CircularGeometry):
        (nv, nu), (dv, du) = geometry.nDetector, geometry.dDetector
        v, u = geometry.offDetector
        offset = (v - ((v0 + v1) / 2 - nv / 2) * dv, u + ((u0 + u1) / 2 - nu / 2) * du)
        return replace(geometry, nDetector=(v1 - v0, u1 - u0), offDetector=offset)
    rays = geometry.rays()
    rays = replace(rays, corner=rays.corner + u0 * rays.u + v0 * rays.v)
    return Geometry.from_poses(rays, (v1 - v0, u1 - u0), grid=geometry.grid)


def grid_in_view(geometry: Geometry) -> Geometry:
    """Voxels as large as a pixel on the axis, around it, as far as the panel sees; without an offOrigin as high as its rows."""
    (nv, nu), step = geometry.nDetector, geometry.dDetector[1]
    if geometry.mode == 'cone':
        step *= geometry.DSO / geometry.DSD
    rays = geometry.rays()
    across = np.cross(rays.u, rays.v)
    corners = np.stack([rays.corner + x * rays.u + y * rays.v for x in (0, nu) for y in (0, nv)])
    start, along = (corners, rays.source) if rays.parallel else (rays.source, corners - rays.source)
    # Where they meet the plane through the origin that is parallel to the panel.
    seen = start - along * ((start * across).sum(-1) / (along * across).sum(-1))[..., None]
    low, high = seen[..., 2].min(), seen[..., 2].max()
    side, height = (max(1, int(np.ceil(x / step - 1e-6))) for x in (2 * np.hypot(*seen[..., :2].T).max(), high - low))
    middle = geometry.grid.centre if any(geometry.grid.centre) else (0.0, 0.0, (low + high) / 2)
    return geometry.on(Grid((side, side, height), (step,) * 3, middle))
