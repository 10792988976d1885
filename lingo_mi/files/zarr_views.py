"""Projections in a Zarr array whose chunks are some whole views, read where they are needed. Zarr 2 and 3."""

from __future__ import annotations

from collections.abc import Iterable
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.common.memory import require_room
from lingo_mi.files.ome_zarr import require_codecs
from lingo_mi.files.stored_views import FileViews, require_projections, span
from lingo_mi.storage.file_access import optional, reading

VIEWS = 4  # views of a chunk that is written


class ZarrViews(FileViews):
    """Views of a Zarr array [n, v, u], see `FileViews`."""

    def _read(self, numbers: np.ndarray) -> np.ndarray:
        array = _opened(self.path)
        _require_chunks(self.path, array, np.unique(numbers // int(array.chunks[0])))
        try:
            with reading(self.path, folder=True):
                return array.oindex[numbers]
        except InputError:
            raise
        except Exception as error:  # codecs raise many kinds
            raise InputError(
                f'{self.path}: a chunk of the views {span(numbers)} is cut off or damaged ({brief(error, 80)}); write it again'
            ) from None


def zarr_views(path: Path, rows_run_up: bool = False) -> ZarrViews:
    """The projections of a Zarr array. None are read yet.

    Parameters
    ----------
    path : Path
        Folder of the array.
    rows_run_up : bool
        Whether the rows of the array run up.

    Raises
    ------
    InputError
        If it is damaged, lacks chunks, or is not an array of real numbers [n, v, u].

    Examples
    --------
    >>> zarr_views(Path('scan.zarr'))[:4]
    """
    path = path.absolute()  # workers have other working directories
    array = _opened(path)
    shape = require_projections(path, tuple(int(n) for n in array.shape), np.dtype(array.dtype))
    if getattr(array, 'shards', None):
        raise InputError(f'{path}: keeps several chunks in a file (shards); write it with chunks alone')
    if min(array.chunks) < 1:
        raise InputError(f'{path}: has chunks of the shape {list(array.chunks)}; write it again')
    require_room(prod(int(n) for n in array.chunks) * np.dtype(array.dtype).itemsize, path)
    _require_chunks(path, array, range(-(-shape[0] // int(array.chunks[0]))))
    return ZarrViews(path, shape, np.arange(shape[0]), rows_run_up)


def new_zarr_views(folder: Path, shape: tuple[int, int, int]) -> Any:
    """A new Zarr array of projections in an empty folder, `VIEWS` views a chunk, to be filled by chunks.

    Parameters
    ----------
    folder : Path
        Folder of the array.
    shape : tuple of int
        Shape of the projections [n, v, u].

    Returns
    -------
    zarr.Array
        Float32.

    Raises
    ------
    InputError
        If zarr is not installed.
    """
    return optional('zarr', 'ome-zarr').create_array(
        str(folder),
        shape=shape,
        chunks=(min(VIEWS, shape[0]), *shape[1:]),
        dtype='float32',
        dimension_names=('view', 'v', 'u'),
        config={'write_empty_chunks': True},
        overwrite=True,
    )


def _opened(path: Path) -> Any:
    zarr = optional('zarr', 'ome-zarr')
    with reading(path, folder=True):
        version = require_codecs(path, path)
        try:
            return zarr.open_array(str(path), mode='r', zarr_format=version)
        except Exception as error:  # zarr raises many kinds
            raise InputError(f'{path}: is damaged ({brief(error, 100)}); write it again') from None


def _require_chunks(path: Path, array: Any, chunks: Iterable[int]) -> None:
    """Raises InputError if a chunk has no file, because Zarr would read it as zeros. chunks: along the views."""
    views, *panel = (int(n) for n in array.chunks)
    across = [range(-(-n // size)) for n, size in zip(array.shape[1:], panel)]
    for chunk in chunks:
        for row in across[0]:
            for column in across[1]:
                if not (path / array.metadata.encode_chunk_key((int(chunk), row, column))).is_file():
                    last = min((chunk + 1) * views, array.shape[0]) - 1
                    raise InputError(
                        f'{path}: lacks a chunk of the views {chunk * views} to {last}; write it again, chunks of zeros too '
                        '(write_empty_chunks)'
                    )
