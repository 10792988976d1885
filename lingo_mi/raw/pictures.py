"""Frames as PNG or JPEG 2000 images, 8 or 16 bits of grey, by Pillow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import one_line, reading

SUFFIXES = '.png', '.jp2', '.j2k', '.jpx'
_GREY = {'L', 'I', 'I;16', 'I;16B', 'I;16L'}  # Pillow's names of one whole number a pixel


def read_picture(path: Path) -> np.ndarray:
    """Counts [v, u] of an image, uint8 or uint16.

    Raises
    ------
    InputError
        If it is damaged, or holds colours, a palette or single bits.
    """
    try:
        with reading(path), Image.open(path) as image:
            if image.mode not in _GREY:
                raise InputError(
                    f'{path}: holds {image.mode} pixels (colours, a palette, single bits); write counts as 8 or 16 bits of grey'
                )
            counts = np.asarray(image)
    except InputError:
        raise
    except (Image.DecompressionBombError, SyntaxError, ValueError) as error:
        text = one_line(error)[:120]
        raise InputError(f'{path}: is damaged or not an image ({text}); copy or write it again') from None
    # Older versions of Pillow read 16 bits into 32.
    return counts.astype(np.uint16) if counts.dtype.itemsize > 1 and counts.max(initial=0) < 1 << 16 else counts
