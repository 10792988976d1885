"""Volumes in slices: TIFF stacks and DICOM series."""

from __future__ import annotations

import html
import math
import os
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import require_room
from lingo_mi.files.voxels import LPS_TO_RAS, require_claim
from lingo_mi.storage.file_access import one_line, optional, quiet, reading

_KINDS = {'imagej', 'shaped', 'uniform', 'volumetric', 'bigtiff'}  # of TIFF files, in tifffile's words
_DEFLATED_DICOM = '1.2.840.10008.1.2.1.99'
# Most bytes that one byte may stand for, by TIFF's number of the compression: none, LZW, deflate twice, PackBits.
_RATIO = {1: 1, 5: 4096, 8: 1032, 32946: 1032, 32773: 64}


# Millimetres of the units that ImageJ and OME write.
_MILLIMETRES = {
    **dict.fromkeys(('um', '\u00b5m', '\u03bcm', '\\u00b5m', 'micron', 'microns', 'micrometer'), 1e-3),
    **dict.fromkeys(('mm', 'millimeter', 'millimeters'), 1.0),
    **dict.fromkeys(('in', 'inch', 'inches'), 25.4),
    **dict(nm=1e-6, cm=10.0, m=1e3),
}


def read_folder(folder: Path) -> tuple[np.ndarray, np.ndarray | None, Path | None]:
    """The values [x, y, z] of a folder of slices; a DICOM series' affine [4, 4] in mm (NIfTI's axes); the first slice of TIFF.

    Raises
    ------
    InputError
        If there are none, or they do not make one volume.
    """
    with reading(folder, folder=True):
        tiffs = sorted((f for f in folder.iterdir() if f.suffix.lower() in ('.tif', '.tiff')), key=by_number)
    if tiffs:
        return read_tiff(tiffs), None, tiffs[0]
    with quiet('pydicom'):
        return *_dicom(folder), None


def by_number(path: Path) -> list:
    """A key that sorts slice_9 before slice_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', path.name.lower())]


def require_chain(path: Path) -> None:
    """Raises InputError if a TIFF file's list of images goes round in circles: all of it cannot be longer than the file."""
    left = os.path.getsize(path)
    with open(path, 'rb') as stream:
        head = stream.read(16).ljust(16, b'\0')
        order = '>' if head[:2] == b'MM' else '<'
        big = head[2:4] in (b'\0+', b'+\0')
        count, entry, link = ('Q', 20, 'Q') if big else ('H', 12, 'I')
        (at,) = struct.unpack_from(order + link, head, 8 if big else 4)
        while 0 < at < os.path.getsize(path):
            stream.seek(at)
            (entries,) = struct.unpack_from(order + count, stream.read(8).ljust(8, b'\0'))
            stream.seek(at + struct.calcsize(order + count) + min(entries * entry, left))
            following = stream.read(struct.calcsize(order + link))
            if len(following) < struct.calcsize(order + link):
                return
            left -= stream.tell() - at
            if left < 0:
                raise InputError(f'{path}: is a damaged TIFF file: its list of images has no end; write it again')
            (at,) = struct.unpack(order + link, following)


def tiff_spacing(path: Path) -> tuple[float, float, float | None] | None:
    """The voxel size (x, y, z) in mm that ImageJ or OME wrote into a TIFF file that `read_tiff_file` has read.

    z is None if the file does not give it. Returns None for files of other programs: their resolution is meant for printing.
    """
    tifffile = optional('tifffile')
    try:
        with quiet('tifffile'), reading(path), tifffile.TiffFile(path, _multifile=False) as file:
            page: Any = file.pages[0]
            sizes = _of_ome(page.description) if '<OME' in page.description[:2000] else _of_imagej(file, page)
    except InputError:
        raise
    except Exception:  # a description in another form
        return None
    steps = [size * _MILLIMETRES.get(unit.strip().lower(), math.nan) for size, unit in sizes]
    if len(steps) < 2 or not all(math.isfinite(step) and step > 0 for step in steps):
        return None
    return steps[0], steps[1], steps[2] if len(steps) > 2 else None


def _of_ome(text):
    """(size, unit) along x, y and, if it is there, z."""
    out = []
    for axis in 'XYZ':
        size = re.search(rf'\bPhysicalSize{axis}\s*=\s*["\']([-+.eE\d]+)["\']', text)
        unit = re.search(rf'\bPhysicalSize{axis}Unit\s*=\s*["\']([^"\']*)["\']', text)
        if size is None:
            break
        out.append((float(size[1]), html.unescape(unit[1]) if unit else '\u00b5m'))  # OME's default
    return out


def _of_imagej(file, page):
    """Read an ImageJ stack like `_of_ome`. A stack with slices 1 unit apart does not say so."""
    metadata = file.imagej_metadata or {}
    if 'unit' not in metadata or not {'XResolution', 'YResolution'} <= {tag.name for tag in page.tags}:
        return []
    unit, out = str(metadata['unit']), []
    for name in ('XResolution', 'YResolution'):
        pixels, length = page.tags[name].value
        out.append((length / pixels if pixels else math.nan, unit))
    depth = metadata.get('spacing', 1.0 if int(metadata.get('slices', metadata.get('images', 1))) > 1 else None)
    return out if depth is None else [*out, (abs(float(depth)), str(metadata.get('zunit', unit)))]


def read_tiff_file(path: Path) -> np.ndarray:
    """The first series of images of a TIFF file, as it is stored.

    Raises
    ------
    InputError
        If it is damaged, or claims too much.
    """
    tifffile = optional('tifffile')
    try:
        with reading(path):
            require_chain(path)
        # Some microscopes' own descriptions lead to other files, or to more images than exist, and are not followed. The kinds
        # that tifffile (from 2026.4) finds by the first image's tags alone cannot be set.
        kinds = (f'is_{kind}' for kind in tifffile.TIFF.FILE_FLAGS - _KINDS)
        others = {kind: False for kind in kinds if not isinstance(getattr(tifffile.TiffFile, kind, None), property)}
        with quiet('tifffile'), reading(path), tifffile.TiffFile(path, _multifile=False, **others) as file:
            series = file.series[0]
            if 'S' in series.axes:
                raise InputError(f'{path}: holds colours; convert it to one value a pixel')
            compressions = {int(page.compression) for page in series.pages if page is not None}
            ratio = max((_RATIO.get(kind, math.inf) for kind in compressions), default=math.inf)
            require_claim(path, series.shape, np.dtype(series.dtype), ratio)
            return series.asarray()
    except InputError:
        raise
    except Exception as error:  # damaged files fail inside tifffile and its codecs in many ways
        raise InputError(f'{path}: is damaged or not a TIFF file ({one_line(error)}); write it again') from None


def read_tiff(files: list[Path]) -> np.ndarray:
    """The values [x, y, z] of one file of [z, y, x], or of several of [y, x].

    Raises
    ------
    InputError
        If there are none.
    """
    slices = [read_tiff_file(files[0])]
    require_room(len(files) * slices[0].size * 8, files[0])
    slices += [read_tiff_file(file) for file in files[1:]]
    if len(slices) == 1:
        return (slices[0][None] if slices[0].ndim == 2 else slices[0]).transpose()
    for file, image in zip(files, slices):
        if image.ndim != 2 or image.shape != slices[0].shape:
            raise InputError(
                f'{file}: has the shape {image.shape}, but the slices of a folder must be 2D '
                f'and of one size (the first is {slices[0].shape})'
            )
    return np.stack(slices).transpose()


def _dicom(folder):
    optional('pydicom')  # before files are looked for
    slices = []
    for file in sorted(f for f in folder.iterdir() if f.is_file()):
        data = read_dicom_file(file)
        if data is not None and 'PixelData' in data:
            slices.append((file, data))
    if not slices:
        raise InputError(f'{folder}: holds neither DICOM nor TIFF slices; give the folder that directly holds them')
    try:
        series = {str(s.get('SeriesInstanceUID')) for _, s in slices}
        if len(series) > 1:
            raise InputError(f'{folder}: holds {len(series)} DICOM series; put one series in a folder of its own')
        return _stack_dicom(folder, slices)
    except InputError:
        raise
    except Exception as error:  # pydicom makes sense of an element when it is asked for, and fails in many ways
        raise InputError(
            f'{folder}: a DICOM slice lacks geometry or has unreadable pixels '
            f'({one_line(error)}); export the series again, uncompressed'
        ) from None


def read_dicom_file(file: Path, pixels: bool = True) -> Any:
    """A DICOM file, without its pixels if they are not asked for; None for a file of another kind.

    Raises
    ------
    InputError
        If it is damaged or deflated, or pydicom is not installed.
    """
    pydicom = optional('pydicom')
    try:
        with reading(file):
            # The only syntax that is unpacked whole, whatever it holds, before anything is known of it.
            if pydicom.filereader.read_file_meta_info(file).get('TransferSyntaxUID') == _DEFLATED_DICOM:
                raise InputError(f'{file}: is a deflated DICOM file, which is not read; export the series uncompressed')
            return pydicom.dcmread(file, stop_before_pixels=not pixels)
    except InputError:
        raise
    except pydicom.errors.InvalidDicomError:
        return None
    except Exception as error:
        raise InputError(f'{file}: is a damaged DICOM file ({one_line(error)}); export the series again') from None


def _stack_dicom(folder, slices):
    first = slices[0][1]
    x_axis, y_axis = np.reshape(np.asarray(first.ImageOrientationPatient, float), (2, 3))
    normal = np.cross(x_axis, y_axis)
    row_step, column_step = (float(d) for d in first.PixelSpacing)  # between rows (y), between columns (x)
    for file, s in slices:
        if (
            (s.Rows, s.Columns) != (first.Rows, first.Columns)
            or int(s.get('NumberOfFrames', 1)) != 1
            or not np.allclose(np.asarray(s.PixelSpacing, float), [row_step, column_step], rtol=1e-4)
            or not np.allclose(np.asarray(s.ImageOrientationPatient, float), [*x_axis, *y_axis], atol=1e-3)
        ):
            raise InputError(f'{file}: differs from the other slices in size, pixel spacing or orientation; remove it')
    slices = sorted(
        ((np.asarray(s.ImagePositionPatient, float) @ normal, file, s) for file, s in slices), key=lambda item: item[0]
    )
    depth = np.array([d for d, _, _ in slices])
    places = np.array([np.asarray(s.ImagePositionPatient, float) for _, _, s in slices])
    aside = places - places[0] - np.outer(depth - depth[0], normal)
    if np.abs(aside).max() > 0.5 * min(row_step, column_step):
        raise InputError(
            f'{folder}: the slices are shifted sideways against each other, as by a tilted gantry; resample the series first'
        )
    steps = np.diff(depth)
    if len(steps) == 0:
        step = float(first.SliceThickness)
    else:
        step = float(np.median(steps))
        uneven = np.abs(steps - step) > max(0.01 * step, 1e-3)
        if step <= 0 or uneven.any():
            i = int(np.argmax(uneven))
            raise InputError(
                f'{folder}: the slices are not evenly spaced: {steps[i]:g} mm from '
                f'{slices[i][1].name} to {slices[i + 1][1].name}, {step:g} mm elsewhere; '
                'add the missing or remove the extra slices'
            )
    rows, columns = int(first.Rows), int(first.Columns)
    require_room(rows * columns * len(slices) * 12, folder)
    data = np.stack(
        [
            np.float32(s.get('RescaleSlope', 1)) * s.pixel_array + np.float32(s.get('RescaleIntercept', 0))
            for _, _, s in slices
        ]
    )
    affine = np.eye(4)
    affine[:3, :3] = np.stack([x_axis * column_step, y_axis * row_step, normal * step], 1)
    affine[:3, 3] = np.asarray(slices[0][2].ImagePositionPatient, float)
    return data.transpose(2, 1, 0), LPS_TO_RAS @ affine
