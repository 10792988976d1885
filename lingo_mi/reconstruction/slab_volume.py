"""A volume in slabs on a disk: updates read it from one file and write it to another, and a state file counts them."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.slabs import GROWING
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage.file_access import leftovers, read_json, reading, write_text, writing

STATE = 'state.json'
FILES = 'even.f32', 'odd.f32', 'third.f32', 'fourth.f32'
PLANES = '.planes'  # ending of the file that holds the outer slices of another file's slabs
EXCHANGE = 'exchange'  # folder of what the workers of a cluster read and write besides the volume
WORKERS = EXCHANGE, GROWING  # their folders


class Places(NamedTuple):
    """The numbers of the files that hold versions of a volume.

    Attributes
    ----------
    now
        Number of the version that is read; None: it is zero.
    to
        Number of the version that is written.
    begun, swept
        Numbers of the versions before this pass of ASD-POCS (None: it is zero), and after the sweep of this pass.
    """

    now: int | None
    to: int
    begun: int | None = None
    swept: int | None = None


class SlabFiles:
    """A volume in slabs, in some files of a folder: one is read, another one is written.

    Attributes
    ----------
    parts
        (begin, end) of the slabs.
    places
        The files of the versions.
    folder
        Folder of the files.
    """

    def __init__(self, grid: Grid, thickness: int, folder: Path, places: Places):
        self.parts, self.places = grid.slabs(thickness), places
        self._size, self.folder = grid.shape, folder
        self._open: dict[str, Any] = {}
        self._written: set[str] = set()

    def __enter__(self):
        self._stack = ExitStack()
        return self

    def __exit__(self, *error):
        self._stack.close()

    def _file(self, name):
        if name not in self._open:
            with writing(self.folder):
                flags = os.O_RDWR | os.O_CREAT | getattr(os, 'O_BINARY', 0)
                file = os.fdopen(os.open(self.folder / name, flags, 0o666), 'r+b', buffering=0)
            self._open[name] = self._stack.enter_context(file)
        return self._open[name]

    def read(self, part: int, place: int | None) -> np.ndarray:
        """A slab of the version at a place, float32 [x, y, slices]; None: zeros."""
        (begin, end), (nx, ny, _) = self.parts[part], self._size
        shape = nx, ny, end - begin
        return np.zeros(shape, np.float32) if place is None else self._values(FILES[place], begin, shape)

    def read_wide(self, part: int, slices: int, place: int | None) -> tuple[np.ndarray, int]:
        """A slab with up to so many slices of its neighbours on either side, and the number of slices below it. The version must
        have been written with `planes`."""
        (begin, end), (nx, ny, nz) = self.parts[part], self._size
        low, high = max(begin - slices, 0), min(end + slices, nz)
        out = np.empty((nx, ny, high - low), np.float32)
        out[:, :, begin - low : end - low] = self.read(part, place)
        for z in (*range(low, begin), *range(end, high)):
            out[:, :, z - low] = 0 if place is None else self._values(FILES[place] + PLANES, z, (nx, ny))
        return out, begin - low

    def write(self, part: int, slab: np.ndarray, planes: int = 0) -> None:
        """Write a slab of the next version, and so many slices at either end for `read_wide` of its neighbours."""
        begin, end = self.parts[part]
        name = FILES[self.places.to]
        self._put(name, begin, slab)
        for z in {*range(begin, min(begin + planes, end)), *range(max(end - planes, begin), end)}:
            self._put(name + PLANES, z, slab[:, :, z - begin])  # at the place of this slice in a whole volume

    def flush(self) -> None:
        """Wait until all that was written is on the disk."""
        with writing(self.folder):
            while self._written:
                os.fsync(self._file(self._written.pop()).fileno())

    def _values(self, name, slices, shape):
        path, file = self.folder / name, self._file(name)
        with reading(path):
            file.seek(4 * self._size[0] * self._size[1] * slices)
            values = np.fromfile(file, np.float32, prod(shape))
        if len(values) < prod(shape):
            raise InputError(f'{path}: is cut off; remove its folder, and begin again')
        return values.reshape(shape)

    def _put(self, name, slices, values):
        file = self._file(name)
        with writing(self.folder):
            file.seek(4 * self._size[0] * self._size[1] * slices)
            np.ascontiguousarray(values).tofile(file)
        self._written.add(name)


class Volume(SlabFiles):
    """The files of a volume, and its state, which counts the versions.

    Attributes
    ----------
    done
        Number of versions that are complete.
    numbers
        Numbers that the work needs again after an interruption, by name.
    """

    def __init__(
        self, grid: Grid, thickness: int, folder: Path, digest: str, place: Callable[[int], Places], files: int
    ):
        super().__init__(grid, thickness, folder, place(0))
        self.done, self.numbers = 0, {}
        self._digest, self._place, self._names = digest, place, FILES[:files]
        paths = [folder / name for name in self._names]
        for path, _ in leftovers(folder):
            path.unlink()
        if not (folder / STATE).exists() and any(os.path.lexists(path) for path in paths):
            raise InputError(
                f'{folder}: has files named {" or ".join(self._names)} that are not ours; choose another folder'
            )
        done, numbers = read_state(folder, digest)
        read = {place for place in self._place(done) if place is not None} - {self._place(done).to}
        if all(paths[place].exists() for place in read):  # else it was being discarded
            self.done, self.numbers, self.places = done, numbers, self._place(done)
        self._require_room()
        self._record()

    def _require_room(self):
        paths = [self.folder / name for name in self._names]
        needed = 4 * len(paths) * prod(self._size) - sum(path.stat().st_size for path in paths if path.exists())
        if needed > (free := shutil.disk_usage(self.folder).free):
            how_many = {2: 'two', 4: 'four'}[len(paths)]
            raise InputError(
                f'{self.folder}: {how_many} volumes need {needed / 2**30:,.1f} GiB more of the disk, which has '
                f'{free / 2**30:,.1f}; choose another disk, or fewer voxels'
            )

    def turn(self, **numbers: Any) -> None:
        """Make the next version, which is complete, the one that is read. numbers: as `remember` takes them."""
        self.flush()
        self.done += 1
        self.places = self._place(self.done)
        self.remember(**numbers)

    def remember(self, **numbers: Any) -> None:
        """Keep some numbers with the state."""
        self.numbers |= numbers
        self._record()

    def _record(self):
        write_state(self.folder, self._digest, self.done, self.numbers)


def work_folder(path: Path) -> Path:
    """The folder beside a volume that holds it until it is complete."""
    return path.with_name(path.name + '.slabs')


def read_state(folder: Path, digest: str) -> tuple[int, dict[str, Any]]:
    """Return the number of versions that the state file in a folder counts, and its numbers by name; (0, {}) without a file.

    Parameters
    ----------
    digest : str
        Digest of everything that the result depends on.

    Raises
    ------
    InputError
        If the file is damaged, or of another reconstruction.
    """
    state = folder / STATE
    if not state.exists():
        return 0, {}
    content = read_json(state)
    try:
        digest_there, done, numbers = content['of'], int(content['updates']), dict(content.get('numbers', {}))
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(f'{state}: is not a state of ours; move its folder away') from None
    if digest_there != digest:
        raise InputError(
            f'{folder}: holds a reconstruction of other data or with other options, which was stopped; '
            'remove the folder, or repeat that command to complete it'
        )
    return done, numbers


def write_state(folder: Path, digest: str, done: int = 0, numbers: dict[str, Any] | None = None) -> None:
    """Write the file that `read_state` reads."""
    state = {'of': digest, 'updates': done} | ({'numbers': numbers} if numbers else {})
    write_text(folder / STATE, json.dumps(state))


def discard(folder: Path) -> None:
    """Remove the files of a `Volume` and of its workers, and their folder if nothing else lies there."""
    for name in WORKERS:
        shutil.rmtree(folder / name, ignore_errors=True)
    with writing(folder):
        files = *FILES, *(name + PLANES for name in FILES)
        for name in (*files, STATE):  # the state last: it says that the rest is ours
            (folder / name).unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


class Images:
    """An image for each view, float32 [view, pixel], in a temporary file. The images are zero at first."""

    def __init__(self, folder: Path, count: int, pixels: int):
        with writing(folder):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - it is this object's
            self._file.truncate(4 * count * pixels)
        self._folder, self._pixels = folder, pixels

    def __getitem__(self, views: Sequence[int] | np.ndarray) -> np.ndarray:
        return np.stack([self._read(view) for view in views])

    def add(self, images: Iterable[np.ndarray]) -> None:
        """Add one image to each view."""
        for view, image in enumerate(images):
            total = self._read(view) + image
            with writing(self._folder):
                self._file.seek(4 * view * self._pixels)
                self._file.write(total.tobytes())
                self._file.flush()

    def _read(self, view):
        with reading(self._folder, folder=True):
            self._file.seek(4 * int(view) * self._pixels)
            return np.frombuffer(self._file.read(4 * self._pixels), np.float32)
