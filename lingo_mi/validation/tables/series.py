"""Cells for the workers of a cluster: in series of those that need each other."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from lingo_mi.common.errors import InputError
from lingo_mi.jobs.job import Event, Job, Runner, run_all
from lingo_mi.storage.file_access import leftovers
from lingo_mi.storage.folder_lock import locked
from lingo_mi.validation.provenance import command
from lingo_mi.validation.tables.cells import Cells, Fit, Scale, Volume, method_for
from lingo_mi.validation.tables.record import Record


def compute_missing(
    cells: Cells, planned: Sequence[Fit | Volume], runner: Runner, after_each: Callable[[], object]
) -> dict[Fit | Volume, str]:
    """Compute the planned cells that are not stored, side by side, and return the one-line errors of failed ones by cell.

    A series is one job: the fits of an object, a number of views and a method, shorter ones first because longer ones go on from
    them, and the volumes made of these fits. Raises KeyboardInterrupt, which says that the same command goes on.
    """
    series: dict[str, list[Fit | Volume]] = {}
    for cell in planned:
        if cells.get(cell) is None:
            series.setdefault(str(cell.fit if isinstance(cell, Volume) else cell), []).append(cell)
    jobs = [
        Job(
            name,
            sum(map(steps_of(cells.scale), members)),
            compute_series,
            (cells.folder, cells.scale, cells.seed, command(), cells.record, members),
        )
        for name, members in series.items()
    ]

    def tell(event: Event) -> None:
        if event.kind in ('done', 'failed'):
            after_each()

    try:
        failed = run_all(jobs, runner, tell)
    except KeyboardInterrupt:
        raise KeyboardInterrupt('the same command goes on from here') from None
    return {cell: failed[name] for name in failed for cell in series[name] if cells.get(cell) is None}


def steps_of(scale: Scale) -> Callable[[Fit | Volume], int]:
    """A function that gives the steps of a cell's work, for the progress."""
    return lambda cell: method_for(cell, scale).iterations if isinstance(cell, Fit) else 1


def compute_series(
    folder: Path,
    scale: Scale,
    seed: int,
    command: str,
    record: Record | None,
    series: Sequence[Fit | Volume],
    *,
    report: Callable[..., None],
) -> None:
    """Compute those cells of a series that are not stored.

    Raises
    ------
    InputError
        If one of them cannot be computed, after the others.
    """
    cells, done, failed = _cells(folder, scale, seed, command), 0, []
    cells.record = record
    first = series[0].fit if isinstance(series[0], Volume) else series[0]
    home = cells.folder_of(first)
    with locked(home):
        for inside in (home, *(path for path in home.rglob('*') if path.is_dir())):
            for leftover, _ in leftovers(inside):  # of a worker that was killed
                leftover.unlink(missing_ok=True)
        for cell in series:
            if cells.get(cell) is None:
                try:
                    cells.compute(cell, str(cell), lambda step: report(done + step))
                except InputError as error:  # one cell failed: the others are worth having
                    failed.append(error)
            done += steps_of(scale)(cell)
            report(done)
    if failed:
        raise failed[0]


@functools.lru_cache(1)
def _cells(folder: Path, scale: Scale, seed: int, command: str) -> Cells:
    """Kept by a worker for its next series, which may be of the same scan."""
    return Cells(folder, scale, seed, command)
