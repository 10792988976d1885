"""Sweeps over a volume that is larger than memory: it lies on a disk, and one slab of it at a time is worked on.

Line integrals of slabs add up to those of the whole volume if every voxel keeps the weights that it has there. A projector holds
the outermost values for half a voxel, so a slab is projected between two slices of zeros, but at the ends of the volume.

An update of the volume reads it once and writes it once. While a slab is in memory, it is changed by what the last views
lacked, and the line integrals of the next ones are taken.

The volume lies in two files, which updates read and write in turn, and a third file says how many updates they have had. So
work that was stopped at any moment, `kill -9` included, goes on after the last whole update, to the same result: to the last bit
but where the source lies beside the volume: there `GridPair` projects, whose transpose adds in any order.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from math import prod
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.projectors.fastest import projector_class
from lingo_mi.reconstruction.algorithm import Progress
from lingo_mi.reconstruction.preconditions import require_rays
from lingo_mi.reconstruction.sart_update import normalised, updated
from lingo_mi.reconstruction.system import DIVERGED, evaluated, norm, scalar
from lingo_mi.reconstruction.wide_pixels import leave_voxels_out
from lingo_mi.scan import Scan
from lingo_mi.scene.checks import check_memory
from lingo_mi.storage.file_access import leftovers, read_json, reading, write_text, writing
from lingo_mi.storage.folder_lock import locked

Update = tuple[float, np.ndarray]  # relaxation; the numbers of the views
STATE, FILES = 'state.json', ('even.f32', 'odd.f32')
SLABS, IMAGES = (
    7,
    10,
)  # peak memory, in slabs and in images of a view of an update: tests/reconstruction/test_slab_sweeps.py


def swept(
    scan: Scan, updates: Sequence[Update], noneg: bool, thickness: int, folder: Path, progress: Progress | None = None
) -> Iterator[np.ndarray]:
    """The volume after the updates, in slabs [x, y, thickness] along z; the last may be thinner.

    Parameters
    ----------
    folder : Path
        For the files. They stay, so that the volume can be had again at once; `discard` removes them.
    progress : Progress or None
        Called after every slab as progress(slabs updated, slabs to update in all, |A x - b| / |b| of the views of this update
        before it).

    Raises
    ------
    InputError
        For pixels so wide that rays leave voxels out, for too little memory, for a disk without room for two volumes, for a
        folder that holds other work, and if the volume is not finite.
    """
    require_rays(scan.geometry)
    if leave_voxels_out(scan.geometry):
        raise InputError('pixels are two or more voxels wide: make the volume without slabs, or of larger voxels')
    grid = scan.geometry.grid
    blocksize = max(len(views) for _, views in updates)
    check_memory(
        scan.geometry.on(grid.slab(*grid.slabs(thickness)[0])), needed=sweep_memory(scan, thickness, blocksize)
    )
    with locked(folder), _Volume(scan, thickness, folder, _digest(scan, updates, noneg, thickness)) as volume:
        if volume.done < len(updates):
            _complete(_Slabs(scan, volume), updates, noneg, progress)
        for part in range(len(volume.parts)):
            slab = volume.read(part)
            if not np.isfinite(slab).all():
                raise InputError(DIVERGED)
            yield slab


def sweep_memory(scan: Scan, thickness: int, blocksize: int) -> int:
    """Peak memory of `swept` with updates of so many views, bytes."""
    nx, ny, nz = scan.geometry.grid.shape
    slab = nx * ny * min(thickness + 2, nz)  # with its slices of zeros
    images = (2 if scan.valid is None else 3) * len(scan) + IMAGES * blocksize
    return 4 * (SLABS * slab + images * prod(scan.geometry.nDetector))


def discard(folder: Path) -> None:
    """Remove the files of `swept`, and their folder if nothing else lies there."""
    with writing(folder):
        for name in (*FILES, STATE):  # the state last: it says that the rest is ours
            (folder / name).unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def _complete(system: _Slabs, updates: Sequence[Update], noneg: bool, progress: Progress | None) -> None:
    """The updates that are left."""
    volume, lengths = system.volume, system.lengths()
    parts, ax = len(volume.parts), system.project(updates[volume.done][1])
    for done in range(volume.done, len(updates)):
        lmbda, views = updates[done]
        error, relative = system.error(ax, views, lengths)
        following = updates[done + 1][1] if done + 1 < len(updates) else None

        def report(slabs, done=done, relative=relative):
            if progress:
                progress(done * parts + slabs, len(updates) * parts, relative)

        ax = system.update(error, views, lmbda, noneg, following, report)


class _Slabs:
    """The matrix A of a scan, by slabs of a volume on a disk. Images are mi.Float [view, u, v].

    Attributes
    ----------
    A
        That of one slice, for what does not depend on the voxels.
    """

    def __init__(self, scan: Scan, volume: _Volume):
        self.scan, self.volume = scan, volume
        one = scan.geometry.on(scan.geometry.grid.slab(0, 1))
        self.A = projector_class(scan.geometry)(one, scan.valid)

    def lengths(self) -> np.ndarray:
        """A 1, float32 [view, pixel]."""
        out = np.zeros((len(self.scan), self.A.pixels), np.float32)
        for part in range(len(self.volume.parts)):
            A, inside = self._projector(part)
            ones = evaluated(dr.select(inside(dr.arange(mi.UInt, A.voxels)), mi.Float(1), 0))
            for view in range(len(out)):
                out[view] += A.forward(ones, [view])[0].numpy()
        return out

    def project(self, views: np.ndarray) -> mi.Float:
        """A x of some views."""
        ax = self._nothing(views)
        if self.volume.done:
            for part in range(len(self.volume.parts)):
                A, _ = self._projector(part)
                ax = evaluated(ax + A.forward(self._load(part), views)[0])
        return ax

    def error(self, ax: mi.Float | None, views: np.ndarray, lengths: np.ndarray) -> tuple[mi.Float, float]:
        """The normalised error of A x in some views, and |A x - b| / |b|. lengths: of all views, see `lengths`."""
        b = self.A.images(self.scan.projections[views])
        error = evaluated(b - ax)
        relative = norm(error) / (norm(b) or 1.0)
        if not np.isfinite(relative):
            raise InputError(DIVERGED)
        return evaluated(normalised(error, mi.Float(lengths[views].ravel()))), relative

    def update(
        self,
        error: mi.Float,
        views: np.ndarray,
        lmbda: float,
        noneg: bool,
        following: np.ndarray | None,
        report: Callable[[int], None],
    ) -> mi.Float | None:
        """Update the volume by the normalised error of some views, and return A x of the following ones.

        Parameters
        ----------
        report : callable
            Called with the number of slabs that are updated.
        """
        ax = None if following is None else self._nothing(following)
        for part in range(len(self.volume.parts)):
            A, x = self._updated(part, error, views, lmbda, noneg)
            if following is not None:
                ax = evaluated(ax + A.forward(x, following)[0])
            self._store(part, x, A.size)
            report(part + 1)
        self.volume.turn()
        return ax

    def _updated(self, part, error, views, lmbda, noneg):
        """The projector of a slab, and the slab after an update."""
        A, inside = self._projector(part)
        rule = updated(self._load(part), scalar(lmbda), noneg)

        def between_zeros(voxel, *sums):
            return dr.select(inside(voxel), rule(voxel, *sums), 0)

        return A, evaluated(A.adjoint(error, views, between_zeros))

    def _nothing(self, views):
        nothing = dr.zeros(mi.Float, len(views) * self.A.pixels)
        dr.make_opaque(nothing)
        return nothing

    def _margins(self, part):
        """How many slices of zeros lie below and above a slab."""
        begin, end = self.volume.parts[part]
        return int(begin > 0), int(end < self.scan.geometry.grid.shape[2])

    def _projector(self, part):
        """The projector of a slab between its slices of zeros, and a function that tells whether a voxel is none of these."""
        (begin, end), (below, above) = self.volume.parts[part], self._margins(part)
        A = self.A.of_slab(self.scan.geometry.on(self.scan.geometry.grid.slab(begin - below, end + above)))
        low, high = (dr.opaque(mi.UInt, z) for z in (below, end - begin + below))

        def inside(voxel):
            height = voxel % A.size[2]
            return (height >= low) & (height < high)

        return A, inside

    def _load(self, part):
        return mi.Float(np.pad(self.volume.read(part), ((0, 0), (0, 0), self._margins(part))).ravel())

    def _store(self, part, x, size):
        (begin, end), (below, _) = self.volume.parts[part], self._margins(part)
        self.volume.write(part, x.numpy().reshape(size)[:, :, below : below + end - begin])


class _Volume:
    """A volume in slabs, in two files of a folder: one is read, the other written, and they change places.

    Attributes
    ----------
    parts
        (begin, end) of the slabs.
    done
        How often they have changed places; before, the volume is zero.
    """

    def __init__(self, scan: Scan, thickness: int, folder: Path, digest: str):
        self.parts, self.done = scan.geometry.grid.slabs(thickness), 0
        self._size, self._folder, self._digest = scan.geometry.grid.shape, folder, digest
        self._paths = [folder / name for name in FILES]
        state = folder / STATE
        for path, _ in leftovers(folder):
            path.unlink()
        if state.exists():
            known = read_json(state)
            try:
                found, done = known['of'], int(known['updates'])
            except (KeyError, TypeError, ValueError):
                raise InputError(f'{state}: is not a state of ours; move its folder away') from None
            if found != digest:
                raise InputError(
                    f'{folder}: holds a reconstruction of other data or with other options, which was stopped; '
                    'remove the folder, or repeat that command to complete it'
                )
            if self._paths[done % 2].exists():  # else it was being discarded
                self.done = done
        elif any(os.path.lexists(path) for path in self._paths):
            raise InputError(f'{folder}: has files named {" or ".join(FILES)} that are not ours; choose another folder')
        self._require_room()
        self._record()

    def _require_room(self):
        needed = 8 * prod(self._size) - sum(path.stat().st_size for path in self._paths if path.exists())
        if needed > (free := shutil.disk_usage(self._folder).free):
            raise InputError(
                f'{self._folder}: two volumes need {needed / 2**30:,.1f} GiB more of the disk, which has '
                f'{free / 2**30:,.1f}; choose another disk, or fewer voxels'
            )

    def __enter__(self) -> _Volume:
        with writing(self._folder):
            flags = os.O_RDWR | os.O_CREAT | getattr(os, 'O_BINARY', 0)
            self._files = [os.fdopen(os.open(path, flags, 0o666), 'r+b', buffering=0) for path in self._paths]
        return self

    def __exit__(self, *error):
        for file in self._files:
            file.close()

    def read(self, part: int) -> np.ndarray:
        """A slab, float32 [x, y, slices]."""
        shape, start = self._place(part)
        if not self.done:
            return np.zeros(shape, np.float32)
        path, file = self._paths[self.done % 2], self._files[self.done % 2]
        with reading(path):
            file.seek(start)
            values = np.fromfile(file, np.float32, prod(shape))
        if len(values) < prod(shape):
            raise InputError(f'{path}: is cut off; remove its folder, and begin again')
        return values.reshape(shape)

    def write(self, part: int, slab: np.ndarray) -> None:
        """Set a slab of the next volume."""
        file = self._files[(self.done + 1) % 2]
        with writing(self._folder):
            file.seek(self._place(part)[1])
            np.ascontiguousarray(slab).tofile(file)

    def turn(self) -> None:
        """The next volume is complete: it becomes the one that is read."""
        with writing(self._folder):
            os.fsync(self._files[(self.done + 1) % 2].fileno())
        self.done += 1
        self._record()

    def _record(self):
        write_text(self._folder / STATE, json.dumps({'of': self._digest, 'updates': self.done}))

    def _place(self, part):
        (begin, end), (nx, ny, _) = self.parts[part], self._size
        return (nx, ny, end - begin), 4 * nx * ny * begin


def _digest(scan, updates, noneg, thickness):
    """Of all that the result depends on."""
    found = hashlib.sha256(repr((scan.digest(), projector_class(scan.geometry).__name__, noneg, thickness)).encode())
    for lmbda, views in updates:
        found.update(repr((lmbda, views.tolist())).encode())
    return found.hexdigest()
