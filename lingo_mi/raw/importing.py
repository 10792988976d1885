"""Raw frames and a geometry to a scan, one frame at a time, in memory or in a file."""

from __future__ import annotations

import warnings
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import require_room
from lingo_mi.common.progress import Progress
from lingo_mi.files.scans import new_zarr_scan
from lingo_mi.files.zarr_views import VIEWS
from lingo_mi.geometry.base import Geometry
from lingo_mi.raw.beam import Beam
from lingo_mi.raw.frame_geometry import cropped, geometry_of, grid_in_view, has_grid
from lingo_mi.raw.frames import open_recording
from lingo_mi.raw.line_integrals import counts_to_line_integrals, photons_of_images
from lingo_mi.raw.options import Options, chosen_views, exposures, region_of
from lingo_mi.raw.rings import require_enough, ring_offsets
from lingo_mi.scan import Scan

BELOW = -0.1  # lower line integrals, 10 % more counts than the flat, are not noise ...
OFTEN = 0.02  # ... in more than this part of a view's pixels
DARK = 0.005  # part of the other views' light: a closed shutter leaves less
CLIPPED = 1e-3  # if more of a view's pixels have the same highest count, they are saturated


class Imported(NamedTuple):
    """Summary of a scan that was made from raw frames.

    Parameters
    ----------
    geometry : Geometry
        Of its views.
    history : dict
        How it was made, plain values by name, for the scan's file.
    left_out : float
        Share of its pixels that are not valid.
    """

    geometry: Geometry
    history: dict[str, Any]
    left_out: float


def import_raw(
    path: PathLike | str, geometry: PathLike | str | Geometry | None, options: Options, progress: bool = True
) -> tuple[Scan, Imported]:
    """Make a scan of raw frames, in memory.

    Parameters
    ----------
    path : path-like
        A path that `lingo_mi.raw.frames.open_recording` opens.
    geometry : path-like or Geometry or None
        Geometry of the whole frames: a Geometry, a .yml of `lingo_mi.files.scans`, a scanner's own file
        (`frame_geometry.SCANNER_FILES`), or RTK's .xml; None: what the frames' own file says. In a .yml nDetector may be left
        out, and nVoxel and dVoxel: the voxels are then as large as a pixel on the axis.
    options : Options
        How frames become line integrals.
    progress : bool
        Whether to show a progress bar on standard error.

    Raises
    ------
    InputError
        If something is missing, contradictory or damaged; warns of views that are black, saturated or brighter than the flat
        field, and if most pixels are left out.
    """
    frames = _Frames(path, geometry, options)
    # Line integrals and their mask, and the scan's copy of them without invalid pixels.
    require_room(9 * float(np.prod(frames.shape)), path)
    p, valid = np.zeros(frames.shape, np.float32), np.zeros(frames.shape, bool)
    imported = frames.fill(p, valid, progress)
    return Scan(imported.geometry, p, valid), imported


def import_to_zarr(
    path: PathLike | str, geometry: PathLike | str | Geometry | None, options: Options, out: Path, progress: bool = True
) -> Imported:
    """Make a scan of raw frames in a file `out`, .zarr, a few views at a time, so that it need not fit into memory.

    Parameters
    ----------
    path, geometry, options, progress
        As of `import_raw`, which also describes errors and warnings.
    out : Path
        A new folder; the geometry, the mask and many poses lie beside it (`files.scans.new_zarr_scan`).
    """
    frames = _Frames(path, geometry, options)
    with new_zarr_scan(out, frames.geometry) as scan:
        imported = frames.fill(scan.projections, scan.valid, progress)
        scan.history = imported.history
    return imported


class _Frames:
    """Raw frames, and all that turns them into line integrals.

    Attributes
    ----------
    geometry : Geometry
        Of the scan.
    shape : tuple of int
        Of its projections [n, v, u].
    """

    def __init__(self, path: PathLike | str, geometry: PathLike | str | Geometry | None, options: Options):
        recording = open_recording(path)
        if recording.transmission and (options.flats is not None or options.darks is not None):
            raise InputError(f'{path}: its frames are corrected already: leave out flats and darks')
        self._path, self._options, self._recording, self._whole_geometry = path, options, recording, geometry
        self._views = views = recording.views
        self._flats = recording.flats if options.flats is None else open_recording(options.flats).views
        self._darks = recording.darks if options.darks is None else open_recording(options.darks).views
        whole, white, (self._down, self._across) = geometry_of(geometry, options, recording)
        self._crop = region_of('crop', options.crop, views.shape) or (0, views.shape[0], 0, views.shape[1])
        self._chosen, self._exposure = chosen_views(options.views, len(views)), exposures(options.exposure, len(views))
        self._beam = Beam.of(path, options, views, self._flats, self._darks, 1.0 if recording.transmission else white)

        (nv, nu), (v0, v1, u0, u1) = views.shape, self._crop
        rows = (v0, v1) if self._down > 0 else (nv - v1, nv - v0)
        columns = (u0, u1) if self._across > 0 else (nu - u1, nu - u0)
        out = cropped(whole, (*rows, *columns))
        self._bins = out.bins(options.binning)
        if options.binning > max(out.nDetector):
            raise InputError(f'binning {options.binning} is more than the {max(out.nDetector)} pixels of a view')
        out = out.binned(options.binning).subset(self._chosen)
        self.geometry = out if has_grid(geometry) else grid_in_view(out)
        self.shape = len(self._chosen), *self.geometry.nDetector
        if options.rings:
            require_enough(len(self._chosen), self.geometry.nDetector[1])

    def fill(self, p: Any, valid: np.ndarray, progress: bool) -> Imported:
        """Write the line integrals and the mask of valid pixels into arrays [n, v, u] of zeros, a few views at a time.

        Parameters
        ----------
        p : ndarray or zarr.Array
            For the line integrals, which are 0 where they are not valid.
        valid : ndarray
            For the mask.
        progress : bool
            Whether to show a progress bar.
        """
        options, beam, chosen = self._options, self._beam, self._chosen
        part, n = beam.panel.part(self._in_crop), len(chosen)
        levels, light, clipped = np.ones(n), np.zeros(n), {}
        inside, above = np.zeros(n, int), np.zeros(n, int)  # pixels that are valid, and those above the air level
        with Progress('Import', n, shown=progress) as bar:
            for first in range(0, n, VIEWS):
                numbers = range(first, min(first + VIEWS, n))
                block, mask = np.zeros((len(numbers), *self.shape[1:]), np.float32), []
                for k in numbers:
                    i = int(chosen[k])
                    frame, exposure = self._views[i], float(self._exposure[i])
                    levels[k] = beam.level(frame, exposure)  # of the whole frame: air may lie outside the crop
                    view, good = counts_to_line_integrals(
                        self._in_crop(frame),
                        part,
                        self._bins,
                        float(exposure * levels[k]),
                        beam.limit,
                        options.outliers,
                    )
                    block[k - first] = view
                    mask.append(good)
                    view = block[k - first][good]
                    light[k] = np.exp(np.minimum(-view, 50)).sum() / good.size  # no overflow
                    inside[k], above[k] = view.size, (view < BELOW).sum()
                    highest = frame.max()
                    if highest < beam.limit and _full_range(highest) and (frame == highest).mean() > CLIPPED:
                        clipped[i] = highest
                    bar.update(k + 1)
                p[first : first + VIEWS], valid[first : first + VIEWS] = block, mask
        for k in np.flatnonzero(light < DARK * np.median(light)):
            p[k : k + 1], valid[k : k + 1], inside[k], above[k] = 0, False, 0, 0
        left_out = float(1 - inside.sum() / np.prod(self.shape))
        _check_views(self._path, chosen, inside, above, left_out, clipped)
        rings = self._without_rings(p, valid) if options.rings else None
        return Imported(self.geometry, self._history(p, valid, levels, rings), left_out)

    def _in_crop(self, image):
        """The crop, with rows and columns as the geometry has them; before binning, which drops what is left over."""
        v0, v1, u0, u1 = self._crop
        return image[v0:v1, u0:u1][:: self._down, :: self._across]

    def _without_rings(self, p, valid):
        """Subtract the offsets of pixels; their root mean square."""
        offsets = ring_offsets(p, valid)
        for first in range(0, p.shape[0], VIEWS):
            some = slice(first, first + VIEWS)
            p[some] = np.where(valid[some], p[some] - offsets, 0)
        return float(f'{np.sqrt(np.square(offsets).mean()):.4g}')

    def _history(self, p, valid, levels, rings):
        options, beam, recording, photons = self._options, self._beam, self._recording, self._beam.panel.photons
        chosen, bins, flats, darks = self._chosen, self._bins, self._flats, self._darks
        geometry = self._whole_geometry
        history: dict[str, Any] = dict(
            frames=str(self._path),
            geometry='given in Python' if isinstance(geometry, Geometry) else str(geometry or self._path),
            flats=None if flats is None else f'{flats.where} ({len(flats)})',
            darks=None if darks is None else f'{darks.where} ({len(darks)})',
            corrected_before=recording.transmission or None,
            views=[int(chosen[0]), int(chosen[-1]) + 1, int(chosen[1] - chosen[0]) if len(chosen) > 1 else 1],
            crop=list(self._crop),
            binning=list(bins),
            air=None if beam.air is None else list(beam.air),
            air_percentile=options.percentile,
            i0=None if beam.i0 is None else float(beam.i0),
            air_level=[float(f'{np.nanmin(levels):.6g}'), float(f'{np.nanmax(levels):.6g}')],
            rings=rings,
            outliers=True if options.outliers else None,
            bad_pixels=int((~beam.panel.good).sum()),
            photons_from_flats=None if photons is None else float(f'{photons * bins[0] * bins[1]:.4g}'),
            photons_from_views=float(f'{photons_of_images(p, valid):.4g}'),
        )
        return {name: value for name, value in history.items() if value is not None}


def _full_range(count):
    """Return whether a count is the highest one of a converter of 8 bits or more."""
    return count >= 255 and float(np.log2(count + 1)).is_integer()


def _check_views(path, chosen, inside, above, left_out, clipped):
    """Warn of views that are black, saturated or brighter than the flat field, and of few valid pixels. Raises InputError if all
    are black.

    Parameters
    ----------
    inside, above
        [n], how many pixels of a view are valid, and how many of these are above the air level.
    left_out
        Share of all pixels that are not valid.
    clipped
        The highest count by the number of a view that is saturated.
    """
    black = [i for i, count in zip(chosen, inside) if not count]
    above = [i for i, count, bright in zip(chosen, inside, above) if bright > OFTEN * count]
    if len(black) == len(chosen):
        raise InputError(f'{path}: no view is brighter than the dark frames; are the right dark frames given?')
    if black:
        warnings.warn(
            f'{path}: {_list(black)} without counts, or with hardly any (black): left out by the mask; drop them with '
            'views=(first, end, step)',
            stacklevel=5,
        )
    if left_out > 0.5:
        warnings.warn(
            f'{path}: {left_out:.2%} of the pixels are left out: are the flats, the darks and the saturation right?',
            stacklevel=5,
        )
    if clipped:
        highest = max(clipped.values())
        warnings.warn(
            f'{path}: {_list(list(clipped))} saturated: many pixels have exactly the highest count of {highest:g}; give '
            f'saturation={highest:g}',
            stacklevel=5,
        )
    if above:
        warnings.warn(
            f'{path}: {_list(above)} more than 10 % brighter than the air level in {OFTEN:.0%} of the pixels: flats of another '
            'exposure? Give exposure=X, or air=(v0, v1, u0, u1)',
            stacklevel=5,
        )


def _list(views):
    named = ', '.join(map(str, views[:5])) + (', ...' if len(views) > 5 else '')
    return f'view {named} is' if len(views) == 1 else f'{len(views)} views ({named}) are'
