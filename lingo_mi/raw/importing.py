"""Raw frames and a geometry to a scan, one frame at a time."""

from __future__ import annotations

import operator
import warnings
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.files import scanner_dict
from lingo_mi.files.scans import load_yaml, posed_geometry, rows_run_up
from lingo_mi.geometry.base import CircularGeometry, Geometry
from lingo_mi.memory import require_room
from lingo_mi.parsing import checked, whole
from lingo_mi.progress import Progress
from lingo_mi.raw.frames import Frames, open_recording
from lingo_mi.raw.line_integrals import fields, line_integrals, photons_of_images
from lingo_mi.raw.nikon import read_numbers, read_xtekct
from lingo_mi.scan import Scan

BELOW = -0.1  # a line integral that noise does not explain: 10 % more counts than the flat
OFTEN = 0.02  # in this part of a view's pixels


@dataclass(frozen=True)
class Options:
    """How frames become line integrals.

    flats, darks   files or folders of their own; None: those of the recording, if it has any
    air            (v0, v1, u0, u1), pixels of the whole frame where no view has an object: their mean is the air level of a view
    percentile     instead: that percentile of a view is its air level
    i0             instead: counts of the unattenuated beam
    exposure       [n] or one number: exposure of every view over that of the flats
    saturation     counts from here on are not valid; None: the largest value of an integer type
    crop           (v0, v1, u0, u1), pixels of the whole frame to keep
    binning        pixels (v and u) that become one
    views          (first, end, step) of the views to keep; the end may be None
    angles         [n] degrees or the file that lists them, where the geometry does not
    pixel          size of a raw pixel, mm; for a geometry of RTK
    """

    flats: PathLike | str | None = None
    darks: PathLike | str | None = None
    air: tuple[int, int, int, int] | None = None
    percentile: float | None = None
    i0: float | None = None
    exposure: Any = 1.0
    saturation: float | None = None
    crop: tuple[int, int, int, int] | None = None
    binning: int = 1
    views: tuple[int, int | None, int] | None = None
    angles: Any = None
    pixel: float | None = None

    def __post_init__(self):
        """Raises InputError for values of another kind; those that depend on the frames are checked with them."""
        for name in 'percentile', 'i0', 'saturation', 'pixel':
            if getattr(self, name) is not None:
                checked(name, getattr(self, name), 0.0)
        whole('binning', self.binning, 1)
        try:
            first, end, step = (0, None, 1) if self.views is None else self.views
            for value in (first, 0 if end is None else end, step):
                operator.index(value)
        except (TypeError, ValueError):
            raise InputError(
                f'views must be (first, end, step), the end a number or None, not {self.views!r}'
            ) from None


def import_raw(
    path: PathLike | str, geometry: PathLike | str | Geometry, options: Options, progress: bool = True
) -> tuple[Scan, dict[str, Any]]:
    """The scan, and its history: plain values by name, for the scan's file.

    path       what `lingo_mi.raw.frames.open_recording` opens
    geometry   of the whole frames: a Geometry, a .yml of `lingo_mi.files.scans`, Nikon's .xtekct, or RTK's .xml. In a .yml
               nDetector may be left out, and nVoxel and dVoxel: the voxels are then as large as a pixel on the axis

    Raises InputError where something is missing, contradictory or damaged; warns of views that are black or brighter than the
    flat field.
    """
    recording = open_recording(path)
    views, n = recording.views, len(recording.views)
    flats = recording.flats if options.flats is None else open_recording(options.flats).views
    darks = recording.darks if options.darks is None else open_recording(options.darks).views
    given, white, (down, across) = _geometry(geometry, options, recording.angles, views)
    if options.i0 is not None or flats is not None or not _no_air(options):
        white = None  # not needed
    i0 = options.i0 if white is None else white
    if sum(x is not None for x in (options.air, options.percentile, i0)) > 1:
        raise InputError('air, percentile and i0 all say the air level; give one of them')
    if flats is None and i0 is None and _no_air(options):
        raise InputError(
            f'{path}: there are no flat frames; give --flats, or the air level: --air V0 V1 U0 U1 (a region without object), '
            '--air-percentile P, or --i0 COUNTS'
        )
    if i0 is not None and not i0 > 0:
        raise InputError(f'i0 must be positive, not {i0:g}')
    crop = _region('crop', options.crop, views.shape) or (0, views.shape[0], 0, views.shape[1])
    air = _region('air', options.air, views.shape)
    if options.percentile is not None and not 0 < options.percentile <= 100:
        raise InputError(f'the percentile of air must be above 0 and at most 100, not {options.percentile:g}')
    chosen = _chosen(options.views, n)
    exposure = _exposure(options.exposure, n)
    if flats is not None and i0 is not None:
        raise InputError('flats and i0 both say the unattenuated beam; give one of them')
    limit = options.saturation
    if limit is None:
        limit = np.iinfo(views.dtype).max if views.dtype.kind in 'ui' else np.inf
    panel = fields(views.shape, flats, darks, limit)
    if flats is None and i0 is not None:
        # Nikon's white level is a count, with the dark signal in it.
        panel = replace(panel, flat=i0 - panel.dark if white is not None else np.full(views.shape, float(i0)))

    v0, v1, u0, u1 = crop
    (nv, nu), rows, columns = views.shape, (v0, v1), (u0, u1)
    out = _placed(
        given, (*(rows if down > 0 else (nv - v1, nv - v0)), *(columns if across > 0 else (nu - u1, nu - u0)))
    )

    def kept(image):  # before binning, which drops what is left over at the end
        return _cut(image, crop)[::down, ::across]

    bins = out.bins(options.binning)
    out = out.binned(options.binning).subset(chosen)
    if not _grid_given(geometry):
        out = _own_grid(out)
    # Line integrals and their mask, and the scan's copy of them without invalid pixels.
    require_room(9 * len(chosen) * float(np.prod(out.nDetector)), path)
    p = np.zeros((len(chosen), *out.nDetector), np.float32)
    valid = np.zeros(p.shape, bool)
    levels, black, above = np.ones(len(chosen)), [], []
    part = replace(panel, dark=kept(panel.dark), good=kept(panel.good))
    part = replace(part, flat=None if panel.flat is None else kept(panel.flat))
    with Progress('Import', len(chosen), shown=progress) as bar:
        for k, i in enumerate(chosen):
            frame = views[i]
            level = 1.0
            if air is not None or options.percentile is not None:  # of the whole frame: air may lie outside the crop
                level = _air_level(frame, panel, air, options.percentile, float(exposure[i]), limit)
            p[k], valid[k] = line_integrals(kept(frame), part, bins, float(exposure[i] * level), limit)
            levels[k] = level
            seen = p[k][valid[k]]
            if not seen.size:
                black.append(i)
            elif (seen < BELOW).mean() > OFTEN:
                above.append(i)
            bar.update(k + 1)
    if len(black) == len(chosen):
        raise InputError(f'{path}: no view is brighter than the dark frames; are the right dark frames given?')
    if black:
        warnings.warn(
            f'{path}: {_list(black)} without counts (black): left out by the mask; use --views to drop them',
            stacklevel=3,
        )
    if above:
        warnings.warn(
            f'{path}: {_list(above)} more than 10 % brighter than the air level in {OFTEN:.0%} of the pixels: flats of another '
            'exposure? Give --exposure, or --air',
            stacklevel=3,
        )
    scan = Scan(out, p, valid)
    history: dict[str, Any] = dict(
        frames=str(path),
        geometry=str(geometry) if not isinstance(geometry, Geometry) else 'given in Python',
        flats=None if flats is None else f'{flats.where} ({len(flats)})',
        darks=None if darks is None else f'{darks.where} ({len(darks)})',
        views=[int(chosen[0]), int(chosen[-1]) + 1, int(chosen[1] - chosen[0]) if len(chosen) > 1 else 1],
        crop=list(crop),
        binning=list(bins),
        air=None if air is None else list(air),
        air_percentile=options.percentile,
        i0=None if i0 is None else float(i0),
        air_level=[float(f'{np.nanmin(levels):.6g}'), float(f'{np.nanmax(levels):.6g}')],
        bad_pixels=int((~panel.good).sum()),
        photons_from_flats=None if panel.photons is None else float(f'{panel.photons * bins[0] * bins[1]:.4g}'),
        photons_from_views=float(f'{photons_of_images(scan.projections, scan.valid):.4g}'),
    )
    return scan, {name: value for name, value in history.items() if value is not None}


def _no_air(options):
    return options.air is None and options.percentile is None


def _cut(image, region):
    v0, v1, u0, u1 = region
    return image[v0:v1, u0:u1]


def _air_level(frame, panel, air, percentile, exposure, limit):
    good = panel.good & np.isfinite(frame) & (frame < limit)
    counts = frame - panel.dark
    reference = np.full(frame.shape, exposure) if panel.flat is None else panel.flat * exposure
    inside = good if air is None else _cut(good, air)
    if air is not None:
        counts, reference = _cut(counts, air), _cut(reference, air)
    if not inside.any():
        return np.nan
    counts, reference = counts[inside], reference[inside]
    return counts.sum() / reference.sum() if percentile is None else np.percentile(counts / reference, percentile)


def _region(name, region, shape):
    if region is None:
        return None
    try:
        v0, v1, u0, u1 = (int(x) for x in region)
    except (TypeError, ValueError):
        raise InputError(f'{name} must be four whole numbers, (v0, v1, u0, u1), not {region!r}') from None
    if not (0 <= v0 < v1 <= shape[0] and 0 <= u0 < u1 <= shape[1]):
        raise InputError(
            f'{name} = {(v0, v1, u0, u1)} does not lie in a frame of {shape} pixels; it is (v0, v1, u0, u1)'
        )
    return v0, v1, u0, u1


def _chosen(views, n):
    index = np.arange(n)
    if views is not None:
        first, end, step = views
        index = index[first:end:step] if step > 0 else index[:0]
    if not len(index):
        raise InputError(f'no view is left of {n}; views are (first, end, step)')
    return index


def _exposure(exposure, n):
    try:
        values = np.asarray(exposure, float)
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if values.shape not in ((), (1,), (n,)) or not np.all(values > 0):
        raise InputError(f'exposure must be one positive number, or one for each of {n} views')
    return np.broadcast_to(values, (n,))


def _list(views):
    named = ', '.join(map(str, views[:5])) + (', ...' if len(views) > 5 else '')
    return f'view {named} is' if len(views) == 1 else f'{len(views)} views ({named}) are'


# ---- geometry ----------------------------------------------------------------------------------------------


def _grid_given(geometry):
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


def _geometry(source, options, recorded, frames: Frames) -> tuple[Geometry, float | None, tuple[int, int]]:
    """The geometry of whole frames, Nikon's white level, and the steps (1 or -1) that put rows and columns in its order."""
    n, shape = len(frames), frames.shape
    angles = recorded
    if options.angles is not None:
        listed = isinstance(options.angles, str | PathLike)
        try:
            angles = read_numbers(options.angles) if listed else np.atleast_1d(np.asarray(options.angles, float))
        except (TypeError, ValueError):
            raise InputError('angles must be a list of numbers, in degrees, or the name of a file of them') from None
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
            raise InputError(f"{path}: RTK's geometry says no size of pixels; give --pixel, in mm")
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
                    f'{path}: {name} describes projections, not raw frames; take it out, and give --flats, --i0 or --air'
                )
    else:
        raise InputError(f'{path}: is no geometry file; give .yml, .xtekct or .xml (RTK)')
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
            f'{path}: no angles: neither here nor with the frames; add angles or totalAngle, or give --angles'
        )
    if nikon:
        if len(values['angles']) != n:
            raise InputError(
                f'{path}: describes {len(values["angles"])} views, but there are {n} frames; these must agree'
            )
        return scanner_dict.to_geometry(values, np.radians(values['angles']), path), white or None, (1, -1)
    return posed_geometry(values, n, path), None, (-1 if rows_run_up(values) else 1, 1)


def _placed(geometry: Geometry, crop) -> Geometry:
    """The geometry of the pixels (v0, v1, u0, u1) alone."""
    v0, v1, u0, u1 = crop
    if isinstance(geometry, CircularGeometry):
        (nv, nu), (dv, du) = geometry.nDetector, geometry.dDetector
        v, u = geometry.offDetector
        offset = (v - ((v0 + v1) / 2 - nv / 2) * dv, u + ((u0 + u1) / 2 - nu / 2) * du)
        return replace(geometry, nDetector=(v1 - v0, u1 - u0), offDetector=offset)
    rays = geometry.rays()
    rays = replace(rays, corner=rays.corner + u0 * rays.u + v0 * rays.v)
    return Geometry.from_poses(rays, (v1 - v0, u1 - u0), geometry.nVoxel, geometry.dVoxel, geometry.offOrigin)


def _own_grid(geometry: Geometry) -> Geometry:
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
    middle = geometry.offOrigin if any(geometry.offOrigin) else (0.0, 0.0, (low + high) / 2)
    return replace(geometry, nVoxel=(side, side, height), dVoxel=(step,) * 3, offOrigin=middle)
