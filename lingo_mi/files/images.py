"""Single-channel float32 images in OpenEXR files."""

from __future__ import annotations

import os
import struct
import tempfile
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import require_room
from lingo_mi.files.arrays import numeric
from lingo_mi.storage.file_access import one_line, reading, replacing

_LONGEST_HEADER = 1 << 20
_MOST_LINES = 256  # in a block that is compressed as one
_NO_SCAN_LINES = 0x200 | 0x800 | 0x1000  # flags: tiles, deep pixels, several parts


def write_exr(path: PathLike | str, image: np.ndarray) -> None:
    """Writes `image` [v, u] as the float32 channel Y (luminance), whole or not at all.

    Raises
    ------
    InputError
        If the image is not 2D, empty or not finite, or the file cannot be written.
    """
    image = np.ascontiguousarray(numeric(np.asarray(image), path, 2), np.float32)
    header = {'compression': OpenEXR.ZIP_COMPRESSION, 'type': OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        _write(OpenEXR.File(header, {'Y': OpenEXR.Channel(image)}), temporary)


def _write(file: OpenEXR.File, path: Path) -> None:
    """Write an image to a path of any name: the library takes none but those in UTF-8."""
    try:
        str(path).encode('utf-8')
        file.write(str(path))
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            other = Path(folder) / 'image.exr'
            file.write(str(other))
            path.write_bytes(other.read_bytes())
    except RuntimeError as error:  # from the library, for example if the disk is full
        raise OSError(one_line(error)) from None


def read_exr(path: PathLike | str) -> np.ndarray:
    """Reads the channel Y, or the only channel, of an OpenEXR file: float32 [v, u].

    Raises
    ------
    InputError
        If the file is missing, damaged, has several channels and no Y, or is not finite.
    """
    with reading(path):
        with open(path, 'rb') as stream:
            shape, pixel = _shape(stream.read(_LONGEST_HEADER), path)
        # Every block of lines has an offset of 8 bytes.
        if shape[0] > os.path.getsize(path) // 8 * _MOST_LINES:
            raise InputError(f'{path}: is damaged: its header claims {shape[0]} lines; write it again')
        require_room(shape[0] * shape[1] * pixel * 2, path)
    try:
        # From a stream: the library refuses names of files that are not text.
        with open(path, 'rb') as stream, OpenEXR.File(stream, separate_channels=True) as file:
            pixels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # a damaged file fails inside the library in many ways
        raise InputError(f'{path}: is damaged or not an OpenEXR file ({one_line(error)}); write it again') from None
    if 'Y' not in pixels and len(pixels) != 1:
        raise InputError(
            f'{path}: has the channels {shown(sorted(pixels))}; a single-channel (luminance) image is needed'
        )
    image = pixels['Y'] if 'Y' in pixels else next(iter(pixels.values()))
    return numeric(np.array(image, np.float32), path, 2)


def _shape(header: bytes, path: PathLike | str) -> tuple[tuple[int, int], int]:
    """Lines and columns that a file's header claims, and bytes of a pixel: before the library allocates them.

    Raises
    ------
    InputError
        For a damaged header, and for files of another kind than scan lines.
    """
    window: Any = ()
    pixel = 0
    try:
        magic, version = struct.unpack_from('<ii', header)
        if magic != 20000630 or version & _NO_SCAN_LINES:
            raise InputError(f'{path}: is not an OpenEXR file of one image in scan lines; write it again')
        at = 8
        while header[at]:
            end = header.index(0, at)
            name, at = header[at:end], header.index(0, end + 1) + 1
            (size,) = struct.unpack_from('<i', header, at)
            value, at = header[at + 4 : at + 4 + size], at + 4 + size
            if size < 0 or at > len(header):
                raise ValueError('an attribute has no end')
            if name == b'dataWindow':
                window = struct.unpack('<4i', value)
            elif name == b'channels':
                pixel, entry = 0, 0
                while value[entry]:
                    pixel, entry = pixel + 4, value.index(0, entry) + 17
        x0, y0, x1, y1 = window
    except InputError:
        raise
    except (ValueError, IndexError, struct.error) as error:
        raise InputError(f'{path}: is damaged or not an OpenEXR file ({one_line(error)}); write it again') from None
    if x1 < x0 or y1 < y0:
        raise InputError(f'{path}: is damaged: its header claims no pixel; write it again')
    return (y1 - y0 + 1, x1 - x0 + 1), pixel
