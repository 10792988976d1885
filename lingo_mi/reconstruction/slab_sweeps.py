"""Sweeps over a volume that is larger than memory. The volume is on a disk, and one slab of it at a time is in memory.

The line integrals of slabs add up to line integrals of the whole volume if every voxel keeps its weights. A projector holds the
outermost values for half a voxel. So a slab is projected between two slices of zeros, except at the ends of the volume.

An update reads the volume once and writes it once. While a slab is in memory, the update corrects it by the error of the last
views, and takes the line integrals of the next ones.

The volume is in two files, which updates read and write in turn. A third file counts the updates. So after an interruption at any
moment, `kill -9` included, the work continues after the last whole update. The result is the same to the last bit, unless the
source lies beside the volume: `GridPair` then projects, and its transpose adds in any order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, ClassVar, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.grid import Grid
from lingo_mi.projectors.fastest import projector_class
from lingo_mi.reconstruction.algorithm import Progress
from lingo_mi.reconstruction.fdk import FDK, FilteredViews
from lingo_mi.reconstruction.preconditions import require_rays
from lingo_mi.reconstruction.sart_update import normalised, updated
from lingo_mi.reconstruction.slab_volume import Images, Places, SlabFiles, Volume
from lingo_mi.reconstruction.system import DIVERGED, evaluated, norm, scalar
from lingo_mi.reconstruction.wide_pixels import leave_voxels_out
from lingo_mi.scan import Scan
from lingo_mi.scene.checks import check_memory
from lingo_mi.storage.folder_lock import locked

Update = tuple[float, np.ndarray]  # relaxation; the numbers of the views
SLABS, IMAGES = (
    7,
    10,
)  # peak memory, in slabs and in images of a view of an update: tests/reconstruction/test_slab_sweeps.py


class Share(Protocol):
    """Does the same work for every slab of a volume, in this process or on workers."""

    def __call__(self, work: str, *arguments: Any, slab_done: Callable[[], object] = lambda: None) -> Iterable[Any]:
        """Return the result of `SlabSystem.work(part, *arguments)` for each slab, from the first on: an array, or None.

        Parameters
        ----------
        slab_done : callable
            Called when a slab is done.
        """
        ...

    def filtered(self, scan: Scan) -> FilteredViews:
        """The filtered views of a scan, as an argument of the work."""
        ...


@dataclass(frozen=True)
class SweepPlan:
    """The work on a volume in slabs: updates, one after the other.

    Parameters
    ----------
    updates : Sequence[Update]
        Each by a block of views.
    noneg : bool
        Whether negative densities become zero.
    """

    updates: Sequence[Update]
    noneg: bool

    files: ClassVar[int] = 2

    def system(self, geometry: Geometry, valid: np.ndarray | None, volume: SlabFiles) -> SlabSystem:
        """The object that works on the slabs."""
        return SlabSystem(geometry, valid, volume)

    def place(self, done: int) -> Places:
        """The places of the versions after so many of them."""
        return Places(done % 2 if done else None, (done + 1) % 2)

    def digest(self, scan: Scan, thickness: int) -> str:
        """A digest of all that the result depends on."""
        projector = projector_class(scan.geometry).__name__
        digest = hashlib.sha256(repr((scan.digest(), projector, self.noneg, thickness)).encode())
        for lmbda, views in self.updates:
            digest.update(repr((lmbda, views.tolist())).encode())
        return digest.hexdigest()

    def complete(self, system: SlabSystem, share: Share, scan: Scan, progress: Progress | None) -> None:
        """Make the versions of the volume that are missing."""
        volume = system.volume
        assert isinstance(volume, Volume)  # this process keeps its state
        if volume.done < len(self.updates):
            steps = Steps(volume.done, len(self.updates), len(volume.parts), progress)
            lengths = path_lengths(system, share, scan)
            sweep(system, share, scan, lengths, self.updates[volume.done :], self.noneg, steps)


class Steps:
    """Counts the slabs that are done, for `progress`."""

    def __init__(self, done: int, versions: int, parts: int, progress: Progress | None):
        self._done, self._all, self._progress = done * parts, versions * parts, progress

    def __call__(self, relative: float | None = None) -> None:
        """Count one more slab. relative: |A x - b| / |b|, or None."""
        self._done += 1
        if self._progress:
            self._progress(self._done, self._all, relative)


def swept(
    scan: Scan, plan: SweepPlan, thickness: int, folder: Path, progress: Progress | None = None
) -> Iterator[np.ndarray]:
    """The volume after all updates of a plan, in slabs [x, y, thickness] along z; the last may be thinner.

    Parameters
    ----------
    folder : Path
        For the files. They stay, so the next call returns the same volume at once; `discard` removes them.
    progress : Progress or None
        Called after every slab as progress(slabs done, all slabs, residual). The residual is |A x - b| / |b| of the views of this
        update before it, or None.

    Raises
    ------
    InputError
        For pixels so wide that rays leave voxels out, for too little memory, for a disk without room for the versions of the
        volume, for a folder that holds other work, and if the volume is not finite.
    """
    with opened(scan, plan, thickness, folder) as volume:
        system = plan.system(scan.geometry, scan.valid, volume)
        plan.complete(system, _Here(system), scan, progress)
        for part in range(len(volume.parts)):
            yield finite(volume.read(part, volume.places.now))


@contextmanager
def opened(scan: Scan, plan: SweepPlan, thickness: int, folder: Path) -> Iterator[Volume]:
    """The files of a plan, locked for this process; arguments and errors as for `swept`."""
    grid = require_slabs(scan, thickness, plan.updates)
    digest = plan.digest(scan, thickness)
    with locked(folder), Volume(grid, thickness, folder, digest, plan.place, plan.files) as volume:
        yield volume


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
    sets = (scan.stored is None) + (scan.valid is not None)
    images = sets * len(scan) + IMAGES * blocksize
    return 4 * (SLABS * slab + images * prod(scan.geometry.nDetector))


def path_lengths(system: SlabSystem, share: Share, scan: Scan) -> Images:
    """A 1 of every view."""
    return summed(system, share('lengths'), scan)


def summed(system: SlabSystem, slabs: Iterable[Iterable[np.ndarray]], scan: Scan) -> Images:
    """The sum of all slabs' images of every view."""
    total = Images(system.volume.folder, len(scan), system.A.pixels)
    for images in slabs:
        total.add(images)
    return total


def sweep(
    system: SlabSystem,
    share: Share,
    scan: Scan,
    lengths: Images,
    updates: Sequence[Update],
    noneg: bool,
    steps: Steps,
    planes: int = 0,
) -> None:
    """Update the volume by some blocks of views.

    Parameters
    ----------
    planes : int
        Outer slices of a slab that the last update stores, see `SlabFiles.write`.
    """
    volume, following = system.volume, updates[0][1]
    assert isinstance(volume, Volume)
    ax = system.nothing(following)
    if volume.places.now is not None:
        ax = _added(share('project', following), ax)
    for i, (lmbda, views) in enumerate(updates):
        error, relative = _error(system, ax, scan.views(views), lengths[views])
        following = updates[i + 1][1] if i + 1 < len(updates) else None
        outer = planes if following is None else 0
        arguments = error, views, lmbda, noneg, following, outer
        images = share('update', *arguments, slab_done=partial(steps, relative))
        ax = _added(images, None if following is None else system.nothing(following))
        volume.turn()


class _Here:
    """Does the work in this process, slab by slab."""

    def __init__(self, system: SlabSystem):
        self._system = system

    def __call__(self, work, *arguments, slab_done=lambda: None):
        for part in range(len(self._system.volume.parts)):
            yield getattr(self._system, work)(part, *arguments)
            slab_done()

    def filtered(self, scan: Scan) -> FilteredViews:
        return FDK().filtered_views(scan)


def _added(images: Iterable[Any], total: Any) -> Any:
    """The sum of the images of all slabs in their order, so it has the same bits in one process and on workers."""
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
    """The matrix A of a scan for the slabs of a volume on a disk. Images are mi.Float [view, u, v].

    Attributes
    ----------
    A
        The matrix of one slice, for numbers that do not depend on the voxels.
    """

    def __init__(self, geometry: Geometry, valid: np.ndarray | None, volume: SlabFiles):
        self.geometry, self.volume = geometry, volume
        self.A = projector_class(geometry)(geometry.on(geometry.grid.slab(0, 1)), valid)

    def lengths(self, part: int) -> Iterator[np.ndarray]:
        """A 1 of a slab, view by view, float32 [pixel]."""
        A, inside = self._projector(part)
        return self._by_view(A, evaluated(dr.select(inside(dr.arange(mi.UInt, A.voxels)), mi.Float(1), 0)))

    def _by_view(self, A, x):
        for view in range(len(self.geometry)):
            yield A.forward(x, [view])[0].numpy()

    def project(self, part: int, views: np.ndarray) -> mi.Float:
        """A x of a slab in some views."""
        A, _ = self._projector(part)
        return A.forward(self._load(part, self.volume.places.now), views)[0]

    def update(
        self,
        part: int,
        error: mi.Float,
        views: np.ndarray,
        lmbda: float,
        noneg: bool,
        following: np.ndarray | None,
        planes: int,
    ) -> mi.Float | None:
        """Update a slab by the normalised error of some views, and return its A x of the following ones.

        Parameters
        ----------
        planes : int
            See `SlabFiles.write`.
        """
        A, x = self._updated(part, error, views, lmbda, noneg)
        self._store(part, x, A.size, planes)
        return None if following is None else A.forward(x, following)[0]

    def nothing(self, views: np.ndarray) -> mi.Float:
        """Images of zeros of some views."""
        nothing = dr.zeros(mi.Float, len(views) * self.A.pixels)
        dr.make_opaque(nothing)
        return nothing

    def _updated(self, part, error, views, lmbda, noneg):
        """The projector of a slab, and the slab after an update."""
        A, inside = self._projector(part)
        rule = updated(self._load(part, self.volume.places.now), scalar(lmbda), noneg)

        def between_zeros(voxel, *sums):
            return dr.select(inside(voxel), rule(voxel, *sums), 0)

        return A, evaluated(A.adjoint(error, views, between_zeros))

    def _margins(self, part):
        """Return the numbers of slices of zeros below and above a slab."""
        begin, end = self.volume.parts[part]
        return int(begin > 0), int(end < self.geometry.grid.shape[2])

    def _projector(self, part):
        """The projector of a slab between its slices of zeros, and a function that tells whether a voxel lies in the slab."""
        (begin, end), (below, above) = self.volume.parts[part], self._margins(part)
        A = self.A.of_slab(self.geometry.on(self.geometry.grid.slab(begin - below, end + above)))
        low, high = (dr.opaque(mi.UInt, z) for z in (below, end - begin + below))

        def inside(voxel):
            height = voxel % A.size[2]
            return (height >= low) & (height < high)

        return A, inside

    def _load(self, part, place):
        return mi.Float(np.pad(self.volume.read(part, place), ((0, 0), (0, 0), self._margins(part))).ravel())

    def _store(self, part, x, size, planes):
        (begin, end), (below, _) = self.volume.parts[part], self._margins(part)
        self.volume.write(part, x.numpy().reshape(size)[:, :, below : below + end - begin], planes)
