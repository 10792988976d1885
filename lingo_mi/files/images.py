"""Single-channel float32 images in OpenEXR files."""

from __future__ import annotations

from os import PathLike

import numpy as np
import OpenEXR

from lingo_mi.errors import InputError
from lingo_mi.file_access import one_line, reading, replacing
from lingo_mi.files.arrays import numeric


def write_exr(path: PathLike | str, image: np.ndarray) -> None:
    """Writes `image` [v, u] as the float32 channel Y (luminance), whole or not at all.

    Raises InputError if the image is not 2D, empty or not finite, or the file cannot be written.
    """
    image = np.ascontiguousarray(numeric(np.asarray(image), path, 2), np.float32)
    header = {'compression': OpenEXR.ZIP_COMPRESSION, 'type': OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        open(temporary, 'wb').close()  # the file system's errors are clearer than the library's
        OpenEXR.File(header, {'Y': OpenEXR.Channel(image)}).write(str(temporary))


def read_exr(path: PathLike | str) -> np.ndarray:
    """Reads the channel Y, or the only channel, of an OpenEXR file: float32 [v, u].

    Raises InputError if the file is missing, damaged, has several channels and no Y, or is not finite.
    """
    with reading(path):
        open(path, 'rb').close()
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            pixels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise InputError(f'{path}: is damaged or not an OpenEXR file ({one_line(error)}); write it again') from None
    if 'Y' not in pixels and len(pixels) != 1:
        raise InputError(f'{path}: has the channels {sorted(pixels)}; a single-channel (luminance) image is needed')
    image = pixels['Y'] if 'Y' in pixels else next(iter(pixels.values()))
    return numeric(np.array(image, np.float32), path, 2)
