"""Raw frames and a geometry to a scan, one frame at a time."""

from __future__ import annotations

import warnings
from os import PathLike
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import require_room
from lingo_mi.common.progress import Progress
from lingo_mi.geometry.base import Geometry
from lingo_mi.raw.beam import Beam
from lingo_mi.raw.frame_geometry import cropped, geometry_of, grid_in_view, has_grid
from lingo_mi.raw.frames import open_recording
from lingo_mi.raw.line_integrals import counts_to_line_integrals, photons_of_images
from lingo_mi.raw.options import Options, chosen_views, exposures, region_of
from lingo_mi.raw.rings import require_enough, ring_offsets
from lingo_mi.scan import Scan

BELOW = -0.1  # a line integral that noise does not explain: 10 % more counts than the flat
OFTEN = 0.02  # in this part of a view's pixels
DARK = 0.005  # of the light of the other views: what a closed shutter leaves
CLIPPED = 1e-3  # part of a view's pixels with the same highest count


def import_raw(
    path: PathLike | str, geometry: PathLike | str | Geometry | None, options: Options, progress: bool = True
) -> tuple[Scan, dict[str, Any]]:
    """The scan, and its history: plain values by name, for the scan's file.

    Parameters
    ----------
    path : path-like
        A path that `lingo_mi.raw.frames.open_recording` opens.
    geometry : path-like or Geometry or None
        Geometry of the whole frames: a Geometry, a .yml of `lingo_mi.files.scans`, a scanner's own file
        (`frame_geometry.SCANNER_FILES`), or RTK's .xml; None: what the frames' own file says. In a .yml nDetector may be left
        out, and nVoxel and dVoxel: the voxels are then as large as a pixel on the axis.

    Raises
    ------
    InputError
        If something is missing, contradictory or damaged; warns of views that are black, saturated or brighter than the flat
        field, and if most pixels are left out.
    """
    recording = open_recording(path)
    if recording.transmission and (options.flats is not None or options.darks is not None):
        raise InputError(f'{path}: its frames are corrected already: leave out flats and darks')
    views, n = recording.views, len(recording.views)
    flats = recording.flats if options.flats is None else open_recording(options.flats).views
    darks = recording.darks if options.darks is None else open_recording(options.darks).views
    whole, white, steps = geometry_of(geometry, options, recording)
    v0, v1, u0, u1 = crop = region_of('crop', options.crop, views.shape) or (0, views.shape[0], 0, views.shape[1])
    chosen, exposure = chosen_views(options.views, n), exposures(options.exposure, n)
    beam = Beam.of(path, options, views, flats, darks, 1.0 if recording.transmission else white)

    (nv, nu), (down, across) = views.shape, steps
    rows, columns = (v0, v1) if down > 0 else (nv - v1, nv - v0), (u0, u1) if across > 0 else (nu - u1, nu - u0)
    out = cropped(whole, (*rows, *columns))
    bins = out.bins(options.binning)
    if options.binning > max(out.nDetector):
        raise InputError(f'binning {options.binning} is more than the {max(out.nDetector)} pixels of a view')
    out = out.binned(options.binning).subset(chosen)
    if not has_grid(geometry):
        out = grid_in_view(out)
    if options.rings:
        require_enough(len(chosen), out.nDetector[1])
    # Line integrals and their mask, and the scan's copy of them without invalid pixels.
    require_room(9 * len(chosen) * float(np.prod(out.nDetector)), path)

    def in_crop(image):  # before binning, which drops what is left over at the end
        return image[v0:v1, u0:u1][::down, ::across]

    p = np.zeros((len(chosen), *out.nDetector), np.float32)
    valid, levels, part = np.zeros(p.shape, bool), np.ones(len(chosen)), beam.panel.part(in_crop)
    light, clipped = np.zeros(len(chosen)), {}
    with Progress('Import', len(chosen), shown=progress) as bar:
        for k, i in enumerate(chosen):
            frame = views[i]
            levels[k] = beam.level(frame, float(exposure[i]))  # of the whole frame: air may lie outside the crop
            p[k], valid[k] = counts_to_line_integrals(
                in_crop(frame), part, bins, float(exposure[i] * levels[k]), beam.limit, options.outliers
            )
            light[k] = np.exp(np.minimum(-p[k][valid[k]], 50)).sum() / valid[k].size  # no overflow
            highest = frame.max()
            if highest < beam.limit and _full_range(highest) and (frame == highest).mean() > CLIPPED:
                clipped[int(i)] = highest
            bar.update(k + 1)
    dark = light < DARK * np.median(light)
    valid[dark] = False
    _check_views(path, chosen, p, valid, clipped)
    rings = None
    if options.rings:
        offsets = ring_offsets(p, valid)
        p -= offsets
        p[~valid] = 0
        rings = float(f'{np.sqrt(np.square(offsets).mean()):.4g}')
    scan, photons = Scan(out, p, valid), beam.panel.photons
    history: dict[str, Any] = dict(
        frames=str(path),
        geometry='given in Python' if isinstance(geometry, Geometry) else str(geometry or path),
        flats=None if flats is None else f'{flats.where} ({len(flats)})',
        darks=None if darks is None else f'{darks.where} ({len(darks)})',
        corrected_before=recording.transmission or None,
        views=[int(chosen[0]), int(chosen[-1]) + 1, int(chosen[1] - chosen[0]) if len(chosen) > 1 else 1],
        crop=list(crop),
        binning=list(bins),
        air=None if beam.air is None else list(beam.air),
        air_percentile=options.percentile,
        i0=None if beam.i0 is None else float(beam.i0),
        air_level=[float(f'{np.nanmin(levels):.6g}'), float(f'{np.nanmax(levels):.6g}')],
        rings=rings,
        outliers=True if options.outliers else None,
        bad_pixels=int((~beam.panel.good).sum()),
        photons_from_flats=None if photons is None else float(f'{photons * bins[0] * bins[1]:.4g}'),
        photons_from_views=float(f'{photons_of_images(scan.projections, scan.valid):.4g}'),
    )
    return scan, {name: value for name, value in history.items() if value is not None}


def _full_range(count):
    """Return whether a count is the highest one of a converter of 8 bits or more."""
    return count >= 255 and float(np.log2(count + 1)).is_integer()


def _check_views(path, chosen, p, valid, clipped):
    """Warn of views that are black, saturated (`clipped`: the count, by view) or brighter than the flat field, and of few valid
    pixels. Raises InputError if all are black."""
    black = [i for i, inside in zip(chosen, valid) if not inside.any()]
    above = [i for i, view, inside in zip(chosen, p, valid) if (view[inside] < BELOW).sum() > OFTEN * inside.sum()]
    if len(black) == len(chosen):
        raise InputError(f'{path}: no view is brighter than the dark frames; are the right dark frames given?')
    if black:
        warnings.warn(
            f'{path}: {_list(black)} without counts, or with hardly any (black): left out by the mask; drop them with '
            'views=(first, end, step)',
            stacklevel=4,
        )
    if valid.mean() < 0.5:
        warnings.warn(
            f'{path}: {1 - valid.mean():.2%} of the pixels are left out: are the flats, the darks and the saturation right?',
            stacklevel=4,
        )
    if clipped:
        highest = max(clipped.values())
        warnings.warn(
            f'{path}: {_list(list(clipped))} saturated: many pixels have exactly the highest count of {highest:g}; give '
            f'saturation={highest:g}',
            stacklevel=4,
        )
    if above:
        warnings.warn(
            f'{path}: {_list(above)} more than 10 % brighter than the air level in {OFTEN:.0%} of the pixels: flats of another '
            'exposure? Give exposure=X, or air=(v0, v1, u0, u1)',
            stacklevel=4,
        )


def _list(views):
    named = ', '.join(map(str, views[:5])) + (', ...' if len(views) > 5 else '')
    return f'view {named} is' if len(views) == 1 else f'{len(views)} views ({named}) are'
