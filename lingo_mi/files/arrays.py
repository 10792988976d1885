"""Arrays in .npy and .npz files, never unpickled."""

from __future__ import annotations

import math
import os
import zipfile
from os import PathLike
from typing import IO

import numpy as np
from numpy.lib import format as npy

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import require_room
from lingo_mi.storage.file_access import one_line, reading, replacing

_FLOAT32_MAX = float(np.finfo(np.float32).max)
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def numeric(array: np.ndarray, where: PathLike | str, ndim: int | None, finite: bool = True) -> np.ndarray:
    """`array`, after a check that it is real, finite and within float32's range unless it need not be, not empty and has `ndim`
    dimensions (None: any); else InputError."""
    if array.dtype.kind not in 'buif':
        raise InputError(f'{where}: holds {array.dtype} values; real numbers are needed')
    if ndim not in (None, array.ndim) or array.size == 0:
        of = '' if ndim is None else f' of {ndim} dimensions'
        raise InputError(f'{where}: has the shape {array.shape}, but a non-empty array{of} is needed')
    if not finite or array.dtype.kind != 'f':
        return array
    if not np.isfinite(array).all():
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f'{where}: holds NaN or infinity (first at {first}); mask or repair those values first')
    if array.dtype.itemsize > 4 and max(-array.min(), array.max()) > _FLOAT32_MAX:
        raise InputError(f'{where}: holds values beyond 3.4e38, the range of float32; scale them down first')
    return array


def read_npy(path: PathLike | str, ndim: int | None, finite: bool = True) -> np.ndarray:
    """The array of a .npy file.

    Raises
    ------
    InputError
        If it is missing, damaged, pickled, not finite (unless it need not be) or not `ndim`-D (None: any).
    """
    return numeric(_numpy_load(path, np.ndarray), path, ndim, finite)


def read_npz(path: PathLike | str) -> dict[str, np.ndarray]:
    """The arrays of a .npz file by name.

    Raises
    ------
    InputError
        If it is missing, damaged or holds pickled objects.
    """
    return _numpy_load(path, dict)


def _numpy_load(path, kind):
    try:
        with reading(path):
            _check_claims(path)
            loaded = np.load(path, allow_pickle=False)
            if isinstance(loaded, np.lib.npyio.NpzFile):
                with loaded:
                    loaded = {name: a for name, a in loaded.items() if isinstance(a, np.ndarray)}
    except InputError:
        raise
    except Exception as error:  # a damaged header or archive may fail in any way at all
        raise InputError(
            f'{path}: is damaged or not a NumPy file ({one_line(error)}); write it again with numpy.save'
        ) from None
    if not isinstance(loaded, kind):
        raise InputError(f'{path}: its content does not match its suffix; .npy holds one array, .npz several')
    return loaded


def _check_claims(path):
    """Raises InputError or ValueError if an array's header claims more than the file holds, or more than the memory does."""
    if not zipfile.is_zipfile(path):
        with open(path, 'rb') as stream:
            require_room(_claimed(stream, os.path.getsize(path)), path)
        return
    with zipfile.ZipFile(path) as archive:
        members = [info for info in archive.infolist() if info.filename.endswith('.npy')]
        require_room(sum(info.file_size for info in members), path)
        for info in members:
            with archive.open(info) as stream:
                _claimed(stream, info.file_size)


def _claimed(stream: IO[bytes], size: int) -> int:
    """Bytes of the array that a .npy file of `size` bytes announces."""
    shape, _, dtype = _HEADERS[npy.read_magic(stream)](stream)
    claimed = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or not dtype.hasobject and claimed > size:
        raise ValueError(f'its header claims the shape {shown(shape)} of {dtype}, which {size} bytes cannot hold')
    return claimed


def write_npy(path: PathLike | str, array: np.ndarray) -> None:
    """Writes a .npy file, whole or not at all.

    Raises
    ------
    InputError
        If that is impossible.
    """
    with replacing(path) as temporary:
        write_npy_in_place(temporary, array)


def write_npy_in_place(path: PathLike | str, array: np.ndarray) -> None:
    """Writes a .npy file in place, whose content is on the disk afterwards."""
    with open(path, 'wb') as stream:
        np.save(stream, array, allow_pickle=False)
        stream.flush()
        os.fsync(stream.fileno())
