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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from math import prod
from pathlib import Path
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.grid import Grid
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


class Share(Protocol):
    """Does the same work for every slab of a volume, here or elsewhere."""

    def __call__(self, work: str, *arguments: Any, slab_done: Callable[[], object] = lambda: None) -> Iterable[Any]:
        """What `SlabSystem.work(part, *arguments)` returns of each slab, from the first on: an array, or None.

        Parameters
        ----------
        slab_done : callable
            Called when a slab is done.
        """
        ...


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
    grid = require_slabs(scan, thickness, updates)
    with locked(folder), Volume(scan, thickness, folder, digest_of(scan, updates, noneg, thickness)) as volume:
        system = SlabSystem(scan.geometry, scan.valid, volume)
        complete(system, here(system), scan.projections, updates, noneg, progress)
        for part in range(len(grid.slabs(thickness))):
            yield finite(volume.read(part))


def require_slabs(scan: Scan, thickness: int, updates: Sequence[Update]) -> Grid:
    """The voxels of a scan that can be updated in slabs.

    Raises
    ------
    InputError
        For a scan without rays, pixels so wide that rays leave voxels out, and too little memory.
    """
    require_rays(scan.geometry)
    if leave_voxels_out(scan.geometry):
        raise InputError('pixels are two or more voxels wide: make the volume without slabs, or of larger voxels')
    grid = scan.geometry.grid
    blocksize = max(len(views) for _, views in updates)
    check_memory(
        scan.geometry.on(grid.slab(*grid.slabs(thickness)[0])), needed=sweep_memory(scan, thickness, blocksize)
    )
    return grid


def finite(slab: np.ndarray) -> np.ndarray:
    """The slab; raises InputError if it is not finite."""
    if not np.isfinite(slab).all():
        raise InputError(DIVERGED)
    return slab


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


def complete(
    system: SlabSystem,
    share: Share,
    projections: np.ndarray,
    updates: Sequence[Update],
    noneg: bool,
    progress: Progress | None,
) -> None:
    """The updates that are left."""
    volume = system.volume
    assert isinstance(volume, Volume)  # of which this process keeps the state
    if volume.done == len(updates):
        return
    parts, pixels = len(volume.parts), system.A.pixels
    lengths = np.zeros((len(projections), pixels), np.float32)
    for images in share('lengths'):
        for view, image in enumerate(images):
            lengths[view] += image
    ax = system.nothing(updates[volume.done][1])
    if volume.done:
        ax = _added(share('project', updates[volume.done][1]), ax)
    for done in range(volume.done, len(updates)):
        lmbda, views = updates[done]
        error, relative = _error(system, ax, projections[views], lengths[views])
        following = updates[done + 1][1] if done + 1 < len(updates) else None
        slabs = iter(range(done * parts + 1, (done + 1) * parts + 1))

        def report(slabs=slabs, relative=relative):
            if progress:
                progress(next(slabs), len(updates) * parts, relative)

        images = share('update', error, views, lmbda, noneg, following, slab_done=report)
        ax = _added(images, None if following is None else system.nothing(following))
        volume.turn()


def here(system: SlabSystem) -> Share:
    """The work in this process, slab by slab."""

    def share(work, *arguments, slab_done=lambda: None):
        for part in range(len(system.volume.parts)):
            yield getattr(system, work)(part, *arguments)
            slab_done()

    return share


def _added(images: Iterable[Any], total: Any) -> Any:
    """The sum of all slabs' images in their order, so that the same bits come whoever made them."""
    for image in images:
        if total is not None:
            total = evaluated(total + mi.Float(image))
    return total


def _error(system: SlabSystem, ax: mi.Float, projections: np.ndarray, lengths: np.ndarray) -> tuple[mi.Float, float]:
    """The normalised error of A x in some views, and |A x - b| / |b|."""
    b = system.A.images(projections)
    error = evaluated(b - ax)
    relative = norm(error) / (norm(b) or 1.0)
    if not np.isfinite(relative):
        raise InputError(DIVERGED)
    return evaluated(normalised(error, mi.Float(lengths.ravel()))), relative


class SlabSystem:
    """The matrix A of a scan, by slabs of a volume on a disk. Images are mi.Float [view, u, v].

    Attributes
    ----------
    A
        That of one slice, for what does not depend on the voxels.
    """

    def __init__(self, geometry: Geometry, valid: np.ndarray | None, volume: SlabFiles):
        self.geometry, self.volume = geometry, volume
        self.A = projector_class(geometry)(geometry.on(geometry.grid.slab(0, 1)), valid)

    def lengths(self, part: int) -> Iterator[np.ndarray]:
        """A 1 of a slab, view by view, float32 [pixel]."""
        A, inside = self._projector(part)
        ones = evaluated(dr.select(inside(dr.arange(mi.UInt, A.voxels)), mi.Float(1), 0))
        for view in range(len(self.geometry)):
            yield A.forward(ones, [view])[0].numpy()

    def project(self, part: int, views: np.ndarray) -> mi.Float:
        """A x of a slab in some views."""
        A, _ = self._projector(part)
        return A.forward(self._load(part), views)[0]

    def update(
        self, part: int, error: mi.Float, views: np.ndarray, lmbda: float, noneg: bool, following: np.ndarray | None
    ) -> mi.Float | None:
        """Update a slab by the normalised error of some views, and return its A x of the following ones."""
        A, x = self._updated(part, error, views, lmbda, noneg)
        self._store(part, x, A.size)
        return None if following is None else A.forward(x, following)[0]

    def nothing(self, views: np.ndarray) -> mi.Float:
        """Images of zeros of some views."""
        nothing = dr.zeros(mi.Float, len(views) * self.A.pixels)
        dr.make_opaque(nothing)
        return nothing

    def _updated(self, part, error, views, lmbda, noneg):
        """The projector of a slab, and the slab after an update."""
        A, inside = self._projector(part)
        rule = updated(self._load(part), scalar(lmbda), noneg)

        def between_zeros(voxel, *sums):
            return dr.select(inside(voxel), rule(voxel, *sums), 0)

        return A, evaluated(A.adjoint(error, views, between_zeros))

    def _margins(self, part):
        """How many slices of zeros lie below and above a slab."""
        begin, end = self.volume.parts[part]
        return int(begin > 0), int(end < self.geometry.grid.shape[2])

    def _projector(self, part):
        """The projector of a slab between its slices of zeros, and a function that tells whether a voxel is none of these."""
        (begin, end), (below, above) = self.volume.parts[part], self._margins(part)
        A = self.A.of_slab(self.geometry.on(self.geometry.grid.slab(begin - below, end + above)))
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


class SlabFiles:
    """A volume in slabs, in two files of a folder: one is read, the other written.

    Attributes
    ----------
    parts
        (begin, end) of the slabs.
    done
        How often the files have changed places; before, the volume is zero.
    folder
        Of the files.
    """

    def __init__(self, grid: Grid, thickness: int, folder: Path, done: int = 0):
        self.parts, self.done = grid.slabs(thickness), done
        self._size, self.folder = grid.shape, folder
        self._paths = [folder / name for name in FILES]

    def __enter__(self):
        with writing(self.folder):
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
        with writing(self.folder):
            file.seek(self._place(part)[1])
            np.ascontiguousarray(slab).tofile(file)

    def flush(self) -> None:
        """Bring what was written to the disk."""
        with writing(self.folder):
            os.fsync(self._files[(self.done + 1) % 2].fileno())

    def _place(self, part):
        (begin, end), (nx, ny, _) = self.parts[part], self._size
        return (nx, ny, end - begin), 4 * nx * ny * begin


class Volume(SlabFiles):
    """The files, and the state that says how far their work has come."""

    def __init__(self, scan: Scan, thickness: int, folder: Path, digest: str):
        super().__init__(scan.geometry.grid, thickness, folder)
        self._digest = digest
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
        if needed > (free := shutil.disk_usage(self.folder).free):
            raise InputError(
                f'{self.folder}: two volumes need {needed / 2**30:,.1f} GiB more of the disk, which has '
                f'{free / 2**30:,.1f}; choose another disk, or fewer voxels'
            )

    def turn(self) -> None:
        """The next volume is complete: it becomes the one that is read."""
        self.flush()
        self.done += 1
        self._record()

    def _record(self):
        write_text(self.folder / STATE, json.dumps({'of': self._digest, 'updates': self.done}))


def digest_of(scan: Scan, updates: Sequence[Update], noneg: bool, thickness: int) -> str:
    """A digest of all that the result depends on."""
    found = hashlib.sha256(repr((scan.digest(), projector_class(scan.geometry).__name__, noneg, thickness)).encode())
    for lmbda, views in updates:
        found.update(repr((lmbda, views.tolist())).encode())
    return found.hexdigest()
