"""Base of projections in a Zarr array or an HDF5 file: views are read when they are needed, and checked."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.rays import Index
from lingo_mi.scan import StoredViews


@dataclass(frozen=True, eq=False)
class FileViews(StoredViews):
    """Views of an array [n, v, u] in a file. A process that is sent this object opens the file by its path.

    Parameters
    ----------
    path : Path
        Absolute path of the file, or of the folder of a Zarr array.
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

    @abstractmethod
    def _read(self, numbers: np.ndarray) -> np.ndarray:
        """Views of the file by their numbers, of any real type; raises InputError if they cannot be read."""

    def __getitem__(self, index: Index) -> np.ndarray:
        """Line integrals of some views, float32 [view, v, u].

        Raises
        ------
        InputError
            If the file lacks some of them, or they cannot be unpacked or hold NaN. The message names the file.
        """
        numbers = self.numbers[index]
        with np.errstate(over='ignore'):  # infinity is refused below
            views = np.asarray(self._read(numbers), np.float32)
        bad = ~np.isfinite(views).all((1, 2))
        if bad.any():
            raise InputError(
                f'{self.path}: view {numbers[bad][0]} holds NaN or infinity; repair or leave out its pixels'
            )
        return views[:, ::-1] if self.rows_run_up else views

    def subset(self, index: Index) -> FileViews:
        numbers = self.numbers[index]
        return replace(self, numbers=numbers, shape=(len(numbers), *self.shape[1:]))


def require_projections(where: object, shape: tuple[int, ...], dtype: np.dtype) -> tuple[int, int, int]:
    """The shape of an array; raises InputError, in the name of `where`, unless it holds real numbers [n, v, u]."""
    if len(shape) != 3 or min(shape) < 1 or dtype.kind not in 'uif':
        raise InputError(f'{where}: holds {dtype} values of the shape {list(shape)}; real numbers [n, v, u] are needed')
    n, v, u = shape
    return n, v, u


def span(numbers: np.ndarray) -> str:
    """'first to last', for a message."""
    return f'{min(numbers)} to {max(numbers)}'
