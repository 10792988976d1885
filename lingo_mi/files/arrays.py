"""Arrays in .npy and .npz files, never unpickled."""

from __future__ import annotations

from os import PathLike

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.file_access import one_line, reading, replacing


def numeric(array: np.ndarray, where: PathLike | str, ndim: int | None, finite: bool = True) -> np.ndarray:
    """`array`, after a check that it is real, finite unless it need not be, not empty and has `ndim` dimensions
    (None: any); else InputError."""
    if array.dtype.kind not in 'buif':
        raise InputError(f'{where}: holds {array.dtype} values; real numbers are needed')
    if ndim not in (None, array.ndim) or array.size == 0:
        raise InputError(
            f'{where}: has the shape {array.shape}, but a filled array of '
            f'{"" if ndim is None else f"{ndim} "}dimensions is needed'
        )
    if finite and array.dtype.kind == 'f' and not np.isfinite(array).all():
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f'{where}: holds NaN or infinity (first at {first}); mask or repair those values first')
    return array


def load(path: PathLike | str, ndim: int | None, finite: bool = True) -> np.ndarray:
    """The array of a .npy file. Raises InputError if it is missing, damaged, pickled, not finite (unless it need
    not be) or not `ndim`-D (None: any)."""
    return numeric(_numpy_load(path, np.ndarray), path, ndim, finite)


def load_many(path: PathLike | str) -> dict[str, np.ndarray]:
    """The arrays of a .npz file by name. Raises InputError if it is missing, damaged or holds pickled
    objects."""
    return _numpy_load(path, dict)


def _numpy_load(path, kind):
    try:
        with reading(path):
            loaded = np.load(path, allow_pickle=False)
            if isinstance(loaded, np.lib.npyio.NpzFile):
                with loaded:
                    loaded = dict(loaded)
    except InputError:
        raise
    except Exception as error:  # a damaged header or archive may fail in any way at all
        raise InputError(
            f'{path}: is damaged or not a NumPy file ({one_line(error)}); write it again with numpy.save'
        ) from None
    if not isinstance(loaded, kind):
        raise InputError(f'{path}: its content does not match its suffix; .npy holds one array, .npz several')
    return loaded


def save(path: PathLike | str, array: np.ndarray) -> None:
    """Writes a .npy file, whole or not at all. Raises InputError if that is impossible."""
    with replacing(path) as temporary, open(temporary, 'wb') as stream:
        np.save(stream, array, allow_pickle=False)
