"""The .log of Bruker's SkyScan scanners: a circle, and pixels at the size that the scanner was calibrated to."""

from __future__ import annotations

from os import PathLike

import numpy as np

from lingo_mi.raw.recording import Taken
from lingo_mi.raw.settings import Settings

_SCAN = 'Acquisition'


def read_skyscan_log(path: PathLike | str) -> Taken:
    """The circular scan that a .log describes.

    Image Pixel Size (um), at the object, is what Bruker calibrates and its own software reconstructs with, so the panel's pixels
    are made from it.

    Raises
    ------
    InputError
        If the file is missing or damaged, or lacks a number.
    """
    log = Settings.read(path, '.log', _SCAN)
    n, DSO, DSD = log.circle(
        (_SCAN, 'Number Of Files'), (_SCAN, 'Object to Source (mm)'), (_SCAN, 'Camera to Source (mm)')
    )
    rows, columns = (int(log.number(_SCAN, f'Number Of {name}')) for name in ('Rows', 'Columns'))
    pixel = log.number(_SCAN, 'Image Pixel Size (um)') / 1000 * DSD / DSO
    # Counted from either end, it is the middle row for most scans.
    aside = abs(log.number(_SCAN, 'Optical Axis (line)', rows / 2) - rows / 2) > 1
    log.warn_unread(
        ['Optical Axis (line)'] * aside + ['Image Rotation'] * bool(log.number(_SCAN, 'Image Rotation', 0.0))
    )
    return Taken(
        dict(
            DSO=DSO,
            DSD=DSD,
            nDetector=[rows, columns],
            dDetector=[pixel, pixel],
            angles=(log.number(_SCAN, 'Rotation Step (deg)') * np.arange(n)).tolist(),
        )
    )
