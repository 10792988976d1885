"""Slabs of a volume on the workers of a cluster.

The client and its workers exchange data through files in a folder that all of them see: the volume, the arrays that every slab
needs, and the result of each slab. An update reads one file of the volume and writes another one. So if a worker dies, another
one makes its slab again from the same files. The client adds images in the order of the slabs, as one process does, so the sum
has the same bits.

A result stays in the folder until the client has used all results of a step. After a full disk or an interruption, the same call
therefore makes only those slabs that have no result yet.

In an update, every worker reads the error of the views and writes its line integrals of the next ones: 4 bytes a pixel and slab.
In a step of a descent on total variation, it reads two slices of each neighbour, and writes as many at its own ends.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.files.slabs import SharedZarr, shared_zarr
from lingo_mi.geometry.base import Geometry
from lingo_mi.jobs.job import Event, Job, Runner, run_or_refuse
from lingo_mi.reconstruction.algorithm import Progress
from lingo_mi.reconstruction.fdk import FDK, FilteredViews
from lingo_mi.reconstruction.slab_sweeps import SweepPlan, finite, opened
from lingo_mi.reconstruction.slab_volume import EXCHANGE, FILES, Places, SlabFiles, Volume, read_state, write_state
from lingo_mi.scan import Scan
from lingo_mi.storage.file_access import replacing, writing
from lingo_mi.storage.folder_lock import locked

RESULT = '.result'  # ending of the file with the result of a slab


def sweep_on(
    runner: Runner, scan: Scan, plan: SweepPlan, thickness: int, folder: Path, path: Path, progress: Progress | None
) -> None:
    """Let workers make the volume of `slab_sweeps.swept` and write it as OME-Zarr; arguments and errors as there.

    Parameters
    ----------
    runner : Runner
        Runner of the workers, which see `folder` and the place of `path`.
    path : Path
        Path of the OME-Zarr.
    """
    with opened(scan, plan, thickness, folder) as volume, exchange_folder(folder, volume) as exchange:
        if scan.valid is not None:
            np.save(exchange / 'valid.npy', scan.valid)
        share = _Workers(runner, plan, exchange, scan.geometry, thickness, volume)
        plan.complete(plan.system(scan.geometry, scan.valid, volume), share, scan, progress)
        with shared_zarr(path, scan.geometry.grid, folder) as target:
            deliver_on(runner, volume.parts, target, _deliver_slab, (scan.geometry, thickness, folder, volume.places))


def fdk_on(
    runner: Runner, algorithm: FDK, scan: Scan, thickness: int, folder: Path, path: Path, progress: Progress | None
) -> None:
    """Let workers make the volume of `FDK.slabs` and write it as OME-Zarr; arguments as for `sweep_on`.

    This process filters the views of a scan in memory. Workers filter the views of a scan in a file.
    """
    parts, n = scan.geometry.grid.slabs(thickness), len(scan)
    done = iter(range(1, len(parts) + 1))

    def slab_done():
        if progress:
            progress(next(done) * n, len(parts) * n, None)

    with locked(folder), exchange_folder(folder) as exchange:
        claim(folder, repr((scan.digest(), algorithm, thickness)))
        with shared_zarr(path, scan.geometry.grid, folder) as target:
            views = _filtered(algorithm, scan, exchange)
            deliver_on(runner, parts, target, _fdk_slab, (views,), n, slab_done)


def claim(folder: Path, description: str) -> None:
    """Note in a folder what its slabs are.

    Parameters
    ----------
    description : str
        All that the result depends on.

    Raises
    ------
    InputError
        If the folder holds slabs of other work.
    """
    digest = hashlib.sha256(description.encode()).hexdigest()
    read_state(folder, digest)
    write_state(folder, digest)


def deliver_on(
    runner: Runner,
    parts: list[tuple[int, int]],
    target: SharedZarr,
    function: Callable[..., None],
    arguments: tuple,
    steps: int = 1,
    slab_done: Callable[[], object] = lambda: None,
) -> None:
    """Let workers write the slabs that an OME-Zarr does not hold yet.

    Parameters
    ----------
    parts : list[tuple[int, int]]
        (begin, end) of all slabs.
    function : callable
        Called on a worker as function(target, part, *arguments, report=report).
    steps : int
        That it reports.
    slab_done : callable
        Called for every slab that the OME-Zarr holds.

    Raises
    ------
    InputError
        For the first slab that fails twice.
    """
    jobs = []
    for k, part in enumerate(parts):
        if target.holds(part[0]):
            slab_done()
        else:
            jobs.append(Job(f'slab {k}', steps, function, (target, part, *arguments)))
    _run(runner, jobs, slab_done)


def _fdk_slab(target: SharedZarr, part: tuple[int, int], views: FilteredViews, *, report: Callable[..., None]) -> None:
    """Backproject the filtered views into a slab."""
    target.write(part[0], views.slab(part, lambda done, *_: report(done)))


def _deliver_slab(
    target: SharedZarr,
    part: tuple[int, int],
    geometry: Geometry,
    thickness: int,
    folder: Path,
    places: Places,
    *,
    report: Callable[..., None],
) -> None:
    """Copy a slab of the complete volume."""
    report(0)
    with SlabFiles(geometry.grid, thickness, folder, places) as volume:
        target.write(part[0], finite(volume.read(volume.parts.index(part), places.now)))


def _filtered(algorithm: FDK, scan: Scan, exchange: Path) -> FilteredViews:
    with writing(exchange):
        return algorithm.filtered_views(scan, exchange / 'filtered.npy')


@dataclass(frozen=True)
class Stored:
    """Stands for an array in a file of the exchange."""

    name: str


@dataclass(frozen=True)
class SlabTask:
    """One step of the work on a volume, for any of its slabs.

    Parameters
    ----------
    plan : SweepPlan
        Without its updates.
    geometry : Geometry
        Geometry of the scan.
    thickness : int
        Slices of a slab.
    folder, exchange : Path
        Folder of the volume, and folder of the arrays and results.
    places : Places
        Places of the volume's versions.
    step : str
        Name of this step, another one for every version of the volume.
    work : str
        The method of the plan's system.
    arguments : tuple
        Its arguments, `Stored` ones for arrays.
    """

    plan: SweepPlan
    geometry: Geometry
    thickness: int
    folder: Path
    exchange: Path
    places: Places
    step: str
    work: str
    arguments: tuple

    def result(self, part: int) -> Path:
        """The file with the result of a slab, which is empty if there is no array."""
        return self.exchange / f'{self.step}-{part}{RESULT}'


def _slab_work(task: SlabTask, part: int, *, report: Callable[..., None]) -> None:
    """Do the step of a task for a slab, on a worker."""
    report(0)
    with SlabFiles(task.geometry.grid, task.thickness, task.folder, task.places) as volume:
        mask = task.exchange / 'valid.npy'
        system = task.plan.system(task.geometry, np.load(mask) if mask.exists() else None, volume)
        arguments = [mi.Float(np.load(task.exchange / a.name)) if isinstance(a, Stored) else a for a in task.arguments]
        result = getattr(system, task.work)(part, *arguments)
        with replacing(task.result(part)) as temporary:
            if result is not None:
                _save(temporary, result, (len(task.geometry), system.A.pixels))
            volume.flush()  # the result says that the slab is on the disk


def _save(path: Path, result: Any, shape: tuple[int, int]) -> None:
    """Write an array, or the images of all views one by one."""
    if isinstance(result, Iterator):
        file = np.lib.format.open_memmap(path, 'w+', np.float32, shape)
        for view, image in enumerate(result):
            file[view] = image
        file.flush()
    else:
        with open(path, 'wb') as file:
            np.save(file, np.asarray(result))


class _Workers:
    """The work of a plan, by a job a slab."""

    def __init__(
        self, runner: Runner, plan: SweepPlan, exchange: Path, geometry: Geometry, thickness: int, volume: Volume
    ):
        self._runner, self._exchange, self._volume = runner, exchange, volume
        self._fixed = replace(plan, updates=[]), geometry, thickness, volume.folder, exchange

    def __call__(
        self, work: str, *arguments: Any, slab_done: Callable[[], object] = lambda: None
    ) -> Iterator[np.ndarray | None]:
        step = f'{_step(self._volume)}{work}'
        files = [Stored(f'{step}-argument-{i}.npy') if isinstance(a, mi.Float) else a for i, a in enumerate(arguments)]
        task, parts = SlabTask(*self._fixed, self._volume.places, step, work, tuple(files)), self._volume.parts
        jobs = []
        for part in range(len(parts)):
            if task.result(part).exists():
                slab_done()
            else:
                jobs.append(Job(f'slab {part}', 1, _slab_work, (task, part)))
        with _saved(self._exchange, files, arguments):
            _run(self._runner, jobs, slab_done)
        for part in range(len(parts)):
            file = task.result(part)
            yield np.load(file, mmap_mode='r') if file.stat().st_size else None
            file.unlink()

    def filtered(self, scan: Scan) -> FilteredViews:
        return _filtered(FDK(), scan, self._exchange)


@contextmanager
def _saved(exchange: Path, files: Iterable[Any], arguments: Iterable[Any]) -> Iterator[None]:
    """The arrays among the arguments as files, which are removed again.

    Their names are used once, so a job that was cancelled, and still runs, reads no array of a later step.
    """
    stored = [(exchange / file.name, array) for file, array in zip(files, arguments) if isinstance(file, Stored)]
    with writing(exchange):
        for path, array in stored:
            np.save(path, array.numpy())
    try:
        yield
    finally:
        for path, _ in stored:
            path.unlink(missing_ok=True)


def _run(runner: Runner, jobs: list[Job], slab_done: Callable[[], object]) -> None:
    """Run the jobs of slabs; raises InputError for the first that fails twice."""

    def tell(event: Event) -> None:
        if event.kind == 'done':
            slab_done()

    if jobs:
        run_or_refuse(jobs, runner, tell)


def _step(volume: Volume) -> str:
    """Return the beginning of the names of all steps on this version of a volume."""
    return f'{volume.done}-'


@contextmanager
def exchange_folder(folder: Path, volume: Volume | None = None) -> Iterator[Path]:
    """The folder for arrays and results, below the volume's folder. It stays after an error if it holds results.

    Parameters
    ----------
    volume : Volume or None
        Whose results are used again if they belong to its version (None: all are removed).
    """
    exchange, keep = folder / EXCHANGE, None
    if volume is not None and (folder / FILES[volume.places.to]).exists():
        keep = _step(volume)
    with writing(folder):
        exchange.mkdir(exist_ok=True)
        for file in exchange.iterdir():
            if keep is None or not file.name.startswith(keep) or file.suffix != RESULT:
                file.unlink()
    try:
        yield exchange
    finally:
        with suppress(OSError):
            for file in exchange.iterdir():
                if file.suffix != RESULT or file.name.startswith('.'):  # of a job that was stopped while it wrote
                    file.unlink()
            exchange.rmdir()  # unless results are left
