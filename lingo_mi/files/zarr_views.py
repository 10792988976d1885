"""Projections in a Zarr array whose chunks are some whole views, read where they are needed. Zarr 2 and 3."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, brief
from lingo_mi.files.ome_zarr import require_codecs
from lingo_mi.geometry.rays import Index
from lingo_mi.scan import StoredViews
from lingo_mi.storage.file_access import new_folder, optional, reading

VIEWS = 4  # of a chunk that is written


@dataclass(frozen=True, eq=False)
class ZarrViews(StoredViews):
    """Views of a Zarr array [n, v, u]; a process that has this object finds the file by its path.

    Parameters
    ----------
    path : Path
        Folder of the array.
    shape : tuple of int
        Shape of the projections.
    numbers : ndarray
        Numbers of the views in the file.
    rows_run_up : bool
        Whether the rows of the file run up.
    """

    path: Path
    shape: tuple[int, int, int]
    numbers: np.ndarray
    rows_run_up: bool = False

    def __repr__(self) -> str:
        return f'{self.path}{list(self.shape)}'

    def __getitem__(self, index: Index) -> np.ndarray:
        """Line integrals of some views, float32 [view, v, u].

        Raises
        ------
        InputError
            If the file lacks a chunk of them, or a chunk cannot be unpacked or holds NaN. The message names the file.
        """
        numbers, array = self.numbers[index], _opened(self.path)
        _require_chunks(self.path, array, numbers)
        try:
            with reading(self.path, folder=True):
                found = np.asarray(array.oindex[numbers], np.float32)
        except InputError:
            raise
        except Exception as error:  # of codecs: many kinds
            raise InputError(
                f'{self.path}: a chunk of the views {_span(numbers)} is cut off or damaged ({brief(error, 80)}); write it again'
            ) from None
        bad = ~np.isfinite(found).all((1, 2))
        if bad.any():
            raise InputError(
                f'{self.path}: view {numbers[bad][0]} holds NaN or infinity; repair or leave out its pixels'
            )
        return found[:, ::-1] if self.rows_run_up else found

    def subset(self, index: Index) -> ZarrViews:
        numbers = self.numbers[index]
        return replace(self, numbers=numbers, shape=(len(numbers), *self.shape[1:]))


def zarr_views(path: Path, rows_run_up: bool = False) -> ZarrViews:
    """The projections of a Zarr array, none of which are read yet.

    Raises
    ------
    InputError
        If it is damaged, lacks chunks, or is not an array of real numbers [n, v, u].
    """
    path = path.absolute()  # workers have other working directories
    array = _opened(path)
    shape, dtype = tuple(int(n) for n in array.shape), np.dtype(array.dtype)
    if len(shape) != 3 or min(shape) < 1 or dtype.kind not in 'uif':
        raise InputError(f'{path}: holds {dtype} values of the shape {list(shape)}; real numbers [n, v, u] are needed')
    if getattr(array, 'shards', None):
        raise InputError(f'{path}: keeps several chunks in a file (shards); write it with chunks alone')
    numbers = np.arange(shape[0])
    _require_chunks(path, array, numbers)
    return ZarrViews(path, shape, numbers, rows_run_up)


def write_zarr_views(path: Path, projections: np.ndarray) -> None:
    """Write projections as a new Zarr array, `VIEWS` views a chunk.

    Raises
    ------
    InputError
        If `path` exists, or cannot be written.
    """
    zarr = optional('zarr', 'ome-zarr')
    with new_folder(path) as folder:
        array = zarr.create_array(
            str(folder),
            shape=projections.shape,
            chunks=(min(VIEWS, len(projections)), *projections.shape[1:]),
            dtype='float32',
            dimension_names=('view', 'v', 'u'),
            config={'write_empty_chunks': True},
            overwrite=True,
        )
        for first in range(0, len(projections), VIEWS):
            array[first : first + VIEWS] = projections[first : first + VIEWS]


def _opened(path: Path) -> Any:
    zarr = optional('zarr', 'ome-zarr')
    with reading(path, folder=True):
        version = require_codecs(path, path)
        try:
            return zarr.open_array(str(path), mode='r', zarr_format=version)
        except Exception as error:  # of zarr: many kinds
            raise InputError(f'{path}: is damaged ({brief(error, 100)}); write it again') from None


def _require_chunks(path: Path, array: Any, numbers: np.ndarray) -> None:
    """Raises InputError if a chunk of these views has no file, because Zarr would read it as zeros."""
    views, *panel = (int(n) for n in array.chunks)
    across = [range(-(-n // size)) for n, size in zip(array.shape[1:], panel)]
    for chunk in np.unique(np.asarray(numbers) // views):
        for place in product([int(chunk)], *across):
            if not (path / array.metadata.encode_chunk_key(place)).is_file():
                span = _span(np.arange(chunk * views, min((chunk + 1) * views, array.shape[0])))
                raise InputError(
                    f'{path}: lacks a chunk of the views {span}; write it again, chunks of zeros too (write_empty_chunks)'
                )


def _span(numbers: np.ndarray) -> str:
    return f'{min(numbers)} to {max(numbers)}'
