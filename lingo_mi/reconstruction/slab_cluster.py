"""Slabs of a volume on the workers of a cluster.

What workers need and what they find goes through files in a folder that all of them see: the volume, the images that every slab
needs, and the images of each slab. An update reads one file of the volume and writes the other one. So a worker that dies is
replaced, and its slab alone is done again. Images are added in the order of the slabs, which gives the bits of one process.

Per update, every worker reads the error of the views and writes its line integrals of the next ones: 4 bytes a pixel and slab.
Per step of a descent on total variation, it reads two slices of each neighbour, and writes as many at its own ends.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.files.slabs import shared_zarr, write_chunks
from lingo_mi.geometry.base import Geometry
from lingo_mi.jobs.job import Event, Job, Runner, run_or_refuse
from lingo_mi.reconstruction.algorithm import Progress
from lingo_mi.reconstruction.fdk import FDK, FilteredViews
from lingo_mi.reconstruction.slab_sweeps import SweepPlan, finite, opened
from lingo_mi.reconstruction.slab_volume import Places, SlabFiles, Volume
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import replacing, writing
from lingo_mi.storage.folder_lock import locked

EXCHANGE = 'exchange'  # the folder of the images, below that of the volume


@dataclass(frozen=True)
class Stored:
    """Stands for an array that lies in a file of the exchange."""

    name: str


def sweep_on(
    runner: Runner, scan: Scan, plan: SweepPlan, thickness: int, folder: Path, path: Path, progress: Progress | None
) -> None:
    """Write the volume of `slab_sweeps.swept` as OME-Zarr, made by workers; arguments and errors as there.

    Parameters
    ----------
    runner : Runner
        Of the workers, who see `folder` and the place of `path`.
    path : Path
        Of the OME-Zarr.
    """
    with opened(scan, plan, thickness, folder) as volume, _exchange(folder) as images:
        if scan.valid is not None:
            np.save(images / 'valid.npy', scan.valid)
        share = _Workers(runner, plan, images, scan.geometry, thickness, volume)
        plan.complete(plan.system(scan.geometry, scan.valid, volume), share, scan, progress)
        with shared_zarr(path, scan.geometry.grid) as target:
            for _ in share('deliver', target):
                pass


def fdk_on(
    runner: Runner, algorithm: FDK, scan: Scan, thickness: int, folder: Path, path: Path, progress: Progress | None
) -> None:
    """Write the volume of `FDK.slabs` as OME-Zarr, made by workers; arguments as of `sweep_on`.

    This process filters the views of a scan in memory, and workers those that are stored.
    """
    parts, n = scan.geometry.grid.slabs(thickness), len(scan)
    with locked(folder), _exchange(folder) as images, shared_zarr(path, scan.geometry.grid) as target:
        views = _filtered(algorithm, scan, images)
        jobs = [Job(f'slab {k}', n, fdk_slab, (views, part, target)) for k, part in enumerate(parts)]
        done = iter(range(1, len(parts) + 1))
        _run(runner, jobs, lambda: progress and progress(next(done) * n, len(parts) * n, None))


def _filtered(algorithm: FDK, scan: Scan, images: Path) -> FilteredViews:
    with writing(images):
        return algorithm.filtered_views(scan, images / 'filtered.npy')


def fdk_slab(views: FilteredViews, part: tuple[int, int], target: Path, *, report: Callable[..., None]) -> None:
    """Backproject the filtered views into a slab, and write it to the OME-Zarr."""
    write_chunks(target, part[0], views.slab(part, lambda done, *_: report(done)))


def slab_work(
    plan: SweepPlan,
    folder: Path,
    images: Path,
    geometry: Geometry,
    thickness: int,
    places: Places,
    part: int,
    work: str,
    arguments: tuple,
    *,
    report: Callable[..., None],
) -> None:
    """`work(part, *arguments)` of a plan's system on a worker, or `deliver`; its images go to a file of the exchange."""
    report(0)
    with SlabFiles(geometry.grid, thickness, folder, places) as volume:
        if work == 'deliver':
            write_chunks(arguments[0], volume.parts[part][0], finite(volume.read(part, places.now)))
            return
        valid = images / 'valid.npy'
        system = plan.system(geometry, np.load(valid) if valid.exists() else None, volume)
        given = [mi.Float(np.load(images / a.name)) if isinstance(a, Stored) else a for a in arguments]
        found = getattr(system, work)(part, *given)
        if found is not None:
            with replacing(_found(images, part)) as temporary:
                _store(temporary, found, (len(geometry), system.A.pixels))
        volume.flush()


def _store(path: Path, found: Any, shape: tuple[int, int]) -> None:
    """Write an array, or the images of all views one by one."""
    if isinstance(found, Iterator):
        file = np.lib.format.open_memmap(path, 'w+', np.float32, shape)
        for view, image in enumerate(found):
            file[view] = image
        file.flush()
    else:
        with open(path, 'wb') as file:
            np.save(file, np.asarray(found))


class _Workers:
    """The work of a plan, by a job a slab."""

    def __init__(
        self, runner: Runner, plan: SweepPlan, images: Path, geometry: Geometry, thickness: int, volume: Volume
    ):
        self._runner, self._plan, self._images, self._geometry = runner, replace(plan, updates=[]), images, geometry
        self._thickness, self._volume = thickness, volume

    def __call__(
        self, work: str, *arguments: Any, slab_done: Callable[[], object] = lambda: None
    ) -> Iterator[np.ndarray | None]:
        stored = tuple(self._stored(i, argument) for i, argument in enumerate(arguments))
        volume, parts = self._volume, range(len(self._volume.parts))
        what = self._plan, volume.folder, self._images, self._geometry, self._thickness, volume.places
        _run(self._runner, [Job(f'slab {k}', 1, slab_work, (*what, k, work, stored)) for k in parts], slab_done)
        for part in parts:
            found = _found(self._images, part)
            yield np.load(found, mmap_mode='r') if found.exists() else None
            found.unlink(missing_ok=True)

    def filtered(self, scan: Scan) -> FilteredViews:
        return _filtered(FDK(), scan, self._images)

    def _stored(self, i, argument):
        if not isinstance(argument, mi.Float):
            return argument
        with writing(self._images):
            np.save(self._images / f'argument-{i}.npy', argument.numpy())
        return Stored(f'argument-{i}.npy')


def _found(images: Path, part: int) -> Path:
    return images / f'slab-{part}.npy'


def _run(runner: Runner, jobs: list[Job], slab_done: Callable[[], object]) -> None:
    """Run the jobs of all slabs; raises InputError for the first that fails twice."""

    def tell(event: Event) -> None:
        if event.kind == 'done':
            slab_done()

    run_or_refuse(jobs, runner, tell)


@contextmanager
def _exchange(folder: Path) -> Iterator[Path]:
    """An empty folder for images, which is removed again."""
    images = folder / EXCHANGE
    shutil.rmtree(images, ignore_errors=True)  # of work that was killed
    with writing(folder):
        os.mkdir(images)
    try:
        yield images
    finally:
        shutil.rmtree(images, ignore_errors=True)
