"""Slabs of a volume on the workers of a cluster.

What workers need and what they find goes through files in a folder that all of them see: the volume, the images that every slab
needs, and the images of each slab. An update reads one file of the volume and writes the other one. So a worker that dies is
replaced, and its slab alone is done again. Images are added in the order of the slabs, which gives the bits of one process.

Per update, every worker reads the error of the views and writes its line integrals of the next ones: 4 bytes a pixel and slab.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.files.slabs import shared_zarr, write_chunks
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.circle import CircularGeometry
from lingo_mi.jobs.job import Event, Job, Runner, run_or_refuse
from lingo_mi.reconstruction.algorithm import Progress
from lingo_mi.reconstruction.fdk import BATCH, FDK, backprojected
from lingo_mi.reconstruction.slab_sweeps import (
    SlabFiles,
    SlabSystem,
    Update,
    Volume,
    complete,
    digest_of,
    finite,
    require_slabs,
)
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import replacing, writing
from lingo_mi.storage.folder_lock import locked

EXCHANGE = 'exchange'  # the folder of the images, below that of the volume


@dataclass(frozen=True)
class Stored:
    """Stands for an array that lies in a file of the exchange."""

    name: str


def sweep_on(
    runner: Runner,
    scan: Scan,
    updates: Sequence[Update],
    noneg: bool,
    thickness: int,
    folder: Path,
    path: Path,
    progress: Progress | None,
) -> None:
    """Write the volume of `slab_sweeps.swept` as OME-Zarr, made by workers; arguments and errors as there.

    Parameters
    ----------
    runner : Runner
        Of the workers, who see `folder` and the place of `path`.
    path : Path
        Of the OME-Zarr.
    """
    grid = require_slabs(scan, thickness, updates)
    digest = digest_of(scan, updates, noneg, thickness)
    with locked(folder), Volume(scan, thickness, folder, digest) as volume, _exchange(folder) as images:
        if scan.valid is not None:
            np.save(images / 'valid.npy', scan.valid)
        share = _Workers(runner, images, scan.geometry, thickness, volume)
        complete(SlabSystem(scan.geometry, scan.valid, volume), share, scan.projections, updates, noneg, progress)
        with shared_zarr(path, grid) as target:
            for _ in share('deliver', target):
                pass


def fdk_on(
    runner: Runner, algorithm: FDK, scan: Scan, thickness: int, folder: Path, path: Path, progress: Progress | None
) -> None:
    """Write the volume of `FDK.slabs` as OME-Zarr, made by workers; arguments as of `sweep_on`.

    This process filters the views; workers read those that they backproject.
    """
    parts, n = scan.geometry.grid.slabs(thickness), len(scan)
    with locked(folder), _exchange(folder) as images, shared_zarr(path, scan.geometry.grid) as target:

        def stored(shape):
            return np.lib.format.open_memmap(images / 'filtered.npy', 'w+', np.float32, shape)

        with writing(images):
            geometry = algorithm.filtered_views(scan, stored)[1]  # the file is complete once the array is gone
        jobs = [Job(f'slab {k}', n, fdk_slab, (images, geometry, part, target)) for k, part in enumerate(parts)]
        done = iter(range(1, len(parts) + 1))
        _run(runner, jobs, lambda: progress and progress(next(done) * n, len(parts) * n, None))


def fdk_slab(
    images: Path, geometry: CircularGeometry, part: tuple[int, int], target: Path, *, report: Callable[..., None]
) -> None:
    """Backproject the filtered views into a slab, and write it to the OME-Zarr."""
    filtered = np.load(images / 'filtered.npy', mmap_mode='r')
    slab = geometry.on(geometry.grid.slab(*part))
    volume = backprojected(slab, lambda first: filtered[first : first + BATCH], lambda done, *_: report(done))
    write_chunks(target, part[0], volume)


def slab_work(
    folder: Path,
    images: Path,
    geometry: Geometry,
    thickness: int,
    done: int,
    part: int,
    work: str,
    arguments: tuple,
    *,
    report: Callable[..., None],
) -> None:
    """`SlabSystem.work(part, *arguments)` on a worker, or `deliver`; its images go to a file of the exchange.

    Parameters
    ----------
    done : int
        How many updates the volume has had.
    """
    report(0)
    with SlabFiles(geometry.grid, thickness, folder, done) as volume:
        if work == 'deliver':
            write_chunks(arguments[0], volume.parts[part][0], finite(volume.read(part)))
            return
        valid = images / 'valid.npy'
        system = SlabSystem(geometry, np.load(valid) if valid.exists() else None, volume)
        given = [mi.Float(np.load(images / a.name)) if isinstance(a, Stored) else a for a in arguments]
        found = getattr(system, work)(part, *given)
        if found is not None:
            with replacing(_found(images, part)) as temporary, open(temporary, 'wb') as file:
                np.save(file, np.stack(list(found)) if work == 'lengths' else found.numpy())
        if work == 'update':
            volume.flush()


class _Workers:
    """The work of `slab_sweeps.complete`, by a job a slab."""

    def __init__(self, runner: Runner, images: Path, geometry: Geometry, thickness: int, volume: Volume):
        self._runner, self._images, self._geometry = runner, images, geometry
        self._thickness, self._volume = thickness, volume

    def __call__(
        self, work: str, *arguments: Any, slab_done: Callable[[], object] = lambda: None
    ) -> Iterator[np.ndarray | None]:
        stored = tuple(self._stored(i, argument) for i, argument in enumerate(arguments))
        volume, parts = self._volume, range(len(self._volume.parts))
        what = volume.folder, self._images, self._geometry, self._thickness, volume.done
        _run(self._runner, [Job(f'slab {k}', 1, slab_work, (*what, k, work, stored)) for k in parts], slab_done)
        for part in parts:
            found = _found(self._images, part)
            yield np.load(found, mmap_mode='r') if found.exists() else None
            found.unlink(missing_ok=True)

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
