"""Raw frames, read one at a time, and what came with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import Geometry
from lingo_mi.storage.file_access import one_line, reading


@dataclass(frozen=True)
class Frames:
    """Images of one panel.

    Parameters
    ----------
    where : str
        File or folder, for messages.
    count : int
        How many.
    shape : tuple[int, int]
        Pixels (v, u).
    dtype : np.dtype
        Type of the counts as they are stored.
    read : callable
        read(i) -> [v, u], frame i, as it is stored.
    """

    where: str
    count: int
    shape: tuple[int, int]
    dtype: np.dtype
    read: Callable[[int], np.ndarray]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> np.ndarray:
        """Frame i, float64 [v, u]. Raises InputError if it cannot be read, is of another size or holds no real numbers."""
        try:
            with reading(self.where, Path(self.where).is_dir()):
                frame = np.asarray(self.read(i))
        except InputError:
            raise
        except Exception as error:  # damaged files fail inside the readers in many ways
            raise InputError(
                f'{self.where}: frame {i} cannot be read ({one_line(error)[:120]}); copy it again'
            ) from None
        if frame.shape != self.shape:
            raise InputError(
                f'{self.where}: frame {i} has the shape {frame.shape}, but the first one has {self.shape}; all frames need '
                'one panel'
            )
        if frame.dtype.kind not in 'uif':
            raise InputError(f'{self.where}: frame {i} holds {frame.dtype} values; counts are needed')
        return frame.astype(np.float64)

    def subset(self, index: Sequence[int] | np.ndarray) -> Frames:
        """The frames `index` only."""
        index = [int(i) for i in index]
        return Frames(self.where, len(index), self.shape, self.dtype, lambda i: self.read(index[i]))


@dataclass(frozen=True)
class Taken:
    """Geometry of whole frames from a scanner's own file.

    Parameters
    ----------
    scanner : dict or Geometry
        Numbers by the names of `lingo_mi.files.scanner_dict`, without voxels, mm and degrees; or a Geometry, whose voxels do
        not count.
    columns, rows : int
        -1 if columns or rows run the other way than in `scanner`, else 1.
    white : float or None
        Counts of the unattenuated beam, dark ones included.
    """

    scanner: dict[str, Any] | Geometry
    columns: int = 1
    rows: int = 1
    white: float | None = None


@dataclass(frozen=True)
class Recording:
    """Content of one file or folder: the views, and any further data that it has.

    Parameters
    ----------
    views : Frames
        Views of the object.
    flats, darks : Frames or None
        Without object, and without beam.
    angles : ndarray or None
        [n] degrees.
    taken : callable or None
        taken() -> Taken, if it says that. Raises InputError if something is missing, which --geometry can say instead.
    transmission : bool
        Whether the views are shares of the unattenuated beam, which the scanner's software has corrected, and not counts.
    """

    views: Frames
    flats: Frames | None = None
    darks: Frames | None = None
    angles: np.ndarray | None = None
    taken: Callable[[], Taken] | None = None
    transmission: bool = False


def checked(path: PathLike | str, read: Callable[[], Any]) -> Any:
    """Return the result of `read`, and raise an InputError for any error that a damaged file or folder `path` causes."""
    try:
        with reading(path, Path(path).is_dir()):
            return read()
    except InputError:
        raise
    except Exception as error:
        raise InputError(f'{path}: is damaged or of another kind ({one_line(error)[:120]}); copy it again') from None
