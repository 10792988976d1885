"""Projections in a dataset of an HDF5 file, read where they are needed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.common.memory import require_room
from lingo_mi.files.stored_views import FileViews, require_projections, span
from lingo_mi.storage.file_access import optional, reading

SUFFIXES = '.h5', '.hdf5', '.hdf', '.nxs', '.nx'
EXCHANGE = 'exchange/data'  # where Data Exchange keeps projections
RAW = 'exchange/data_white', 'exchange/data_dark'  # beside these, they are raw frames


@dataclass(frozen=True, eq=False, kw_only=True)
class HDF5Views(FileViews):
    """Views of a dataset [n, v, u], see `FileViews`.

    Parameters
    ----------
    dataset : str
        Name of the dataset in the file.
    """

    dataset: str

    def _read(self, numbers: np.ndarray) -> np.ndarray:
        with _opened(self.path, self.dataset) as data:
            rising, order = np.unique(numbers, return_inverse=True)  # as h5py needs them
            first, last = int(rising[0]), int(rising[-1])
            index = slice(first, last + 1) if last - first + 1 == len(rising) else rising
            try:
                views = data[index]
            except Exception as error:  # filters raise many kinds
                raise InputError(
                    f'{self.path}: the views {span(numbers)} are damaged ({brief(error, 80)}); write it again'
                ) from None
        return views if np.array_equal(order, np.arange(len(order))) else views[order]


def hdf5_views(path: Path, dataset: str | None = None, rows_run_up: bool = False) -> HDF5Views:
    """The projections in an HDF5 file. None are read yet.

    Parameters
    ----------
    path : Path
        Path of the file.
    dataset : str or None
        Name of the dataset [n, v, u]; None: /exchange/data of a Data Exchange file without flats and darks.
    rows_run_up : bool
        Whether the rows of the dataset run up.

    Returns
    -------
    HDF5Views
        They read a few views at a time fastest if the chunks of the dataset are some whole views.

    Raises
    ------
    InputError
        If the file is cut off, lacks the dataset or parts of it, or holds no real numbers [n, v, u].

    Examples
    --------
    >>> hdf5_views(Path('scan.h5'), '/entry/data')[:4]
    """
    path = path.absolute()  # workers have other working directories
    with _opened(path, dataset or EXCHANGE) as data:
        where = f'{path}: {data.name}'
        if dataset is None and any(name in data.file for name in RAW):
            raise InputError(
                f'{path}: holds raw frames with flats or darks; make a scan of them: lingo-mi import {path} '
                '--geometry scanner.yml --out scan.zarr'
            )
        try:
            shape = require_projections(where, data.shape or (), data.dtype)
            if data.is_virtual or data.external:
                raise InputError(f'{where} lies in other files; copy it into one file')
            _require_whole(where, data)
        except InputError:
            raise
        except Exception as error:  # damaged headers raise many kinds
            raise InputError(f'{where} is damaged ({brief(error, 100)}); copy it again') from None
    return HDF5Views(path, shape, np.arange(shape[0]), rows_run_up, dataset=dataset or EXCHANGE)


def _require_whole(where: str, data: Any) -> None:
    """Raises InputError if parts of a dataset were never written, because HDF5 would read them as zeros."""
    if data.chunks is None:
        whole = data.id.get_storage_size() >= prod(data.shape) * data.dtype.itemsize
    else:
        require_room(prod(data.chunks) * data.dtype.itemsize, where)
        whole = data.id.get_num_chunks() >= prod(-(-n // chunk) for n, chunk in zip(data.shape, data.chunks))
    if not whole:
        raise InputError(f'{where} lacks views that were never written; write it again')


@contextmanager
def _opened(path: Path, name: str) -> Iterator[Any]:
    """A dataset of a file."""
    h5py = optional('h5py')
    with reading(path):
        open(path, 'rb').close()
    try:
        file = h5py.File(path, 'r')
    except Exception as error:  # a damaged header raises many kinds
        raise InputError(f'{path}: is cut off, damaged or not HDF5 ({brief(error, 100)}); copy it again') from None
    with file:
        try:
            data = file.get(name)
            inside = isinstance(data, h5py.Dataset) and Path(data.file.filename) == path
        except Exception as error:
            raise InputError(f'{path}: is damaged ({brief(error, 100)}); copy it again') from None
        if not inside:
            raise InputError(
                f'{path}: has no dataset {name} in this file; name the dataset of projections in the geometry file, such as '
                'dataset: /entry/data'
            )
        yield data
