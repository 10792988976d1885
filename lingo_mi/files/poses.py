"""Files with one pose per view, in several conventions. `read_poses` chooses the reader.

.xml            RTK's geometry (`lingo_mi.geometry.rtk`): needs dDetector; the panel is centred but for the file's own offsets
.npy, .txt, .csv   12 numbers a view, ASTRA's vectors (`astra`): [n, 12]; or projection matrices (`matrices`):
                [n, 3, 4], which need dDetector, the pixel size that a matrix leaves open
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.files import arrays
from lingo_mi.geometry import astra, matrices, rtk
from lingo_mi.geometry.rays import Rays
from lingo_mi.storage.file_access import one_line, reading


def read_poses(
    path: PathLike | str,
    nDetector: tuple[int, int],
    dDetector: tuple[float, float] | None = None,
    parallel: bool = False,
    towards: ArrayLike = (0.0, 0.0, 0.0),
) -> Rays:
    """The views of a file of poses, in mm.

    Parameters
    ----------
    nDetector : tuple[int, int]
        (v, u) pixels.
    dDetector : tuple[float, float] or None
        (v, u) mm, if the file does not contain it.
    parallel : bool
        Whether a .npy, .txt or .csv has a parallel beam; an .xml contains it.
    towards : array_like
        A point in front of every source, such as the volume's centre; determines the sign of a matrix.

    Raises
    ------
    InputError
        If the file is missing, damaged or of unknown kind, or if it needs dDetector and that is missing.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == '.xml':
        return rtk.read_rtk(path, nDetector, _needed(dDetector, path))
    if suffix == '.npy':
        values = arrays.read_npy(path, None)
    elif suffix in ('.txt', '.csv'):
        values = _table(path)
    else:
        raise InputError(
            f"{path}: is not a known file of poses; give RTK's .xml, or a .npy, .txt or .csv of 12 numbers a view"
        )
    try:
        if values.ndim == 3 and values.shape[1:] == (3, 4):
            return matrices.from_matrices(values, nDetector, _needed(dDetector, path), parallel, towards)
        return astra.from_vectors(values, nDetector, parallel)
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f'{path}: {error}') from None


def _needed(dDetector, path):
    if dDetector is None:
        raise InputError(f'{path}: does not say the size of a pixel; add dDetector')
    return dDetector


def _table(path):
    try:
        with reading(path):
            text = path.read_text(encoding='utf-8')
        rows = [line.split('#')[0].replace(',', ' ').split() for line in text.splitlines()]
        return np.array([[float(x) for x in row] for row in rows if row], float)
    except InputError:
        raise
    except (ValueError, MemoryError) as error:  # also for rows of different lengths, and for bytes that are not text
        raise InputError(f'{path}: is not a table of 12 numbers a view ({one_line(error)})') from None
