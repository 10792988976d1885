"""Runs a cohort: what is missing of it, with the table and the log updated after every scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lingo_mi.cohort.listing import BadList
from lingo_mi.cohort.row import Row, stored
from lingo_mi.cohort.table import CSV, PARQUET, Log, Table
from lingo_mi.cohort.work import fit_row
from lingo_mi.common.errors import InputError, printable
from lingo_mi.jobs.job import Event, Job, Runner, run_all
from lingo_mi.storage.file_access import leftovers


@dataclass(frozen=True)
class Outcome:
    """numbers: metrics of each scan that is done, by name; failed: the one line of each that is not; files: of the table."""

    numbers: dict[str, dict]
    failed: dict[str, str]
    files: list[Path]


def done_already(rows: Sequence[Row], out: Path) -> dict[str, dict]:
    """The metrics of the rows whose results are in the folder `out`, by name.

    Raises `BadList` if a row's folder holds something else.
    """
    done, bad = {}, []
    for row in rows:
        try:
            if (numbers := stored(out, row)) is not None:
                done[row.name] = numbers
        except InputError as error:
            bad.append(printable(f'line {row.line} ({row.name}): {error}'))
    if bad:
        raise BadList(f'{out}: {len(bad)} of {len(rows)} rows cannot be used, so nothing was begun', bad)
    return done


def run_cohort(rows: Sequence[Row], out: Path, runner: Runner, done: dict[str, dict]) -> Outcome:
    """Fit the scans that are not done, in a folder that no other batch writes to.

    A scan that fails is tried once more after all others. After KeyboardInterrupt, or a kill, the same call goes on.

    Parameters
    ----------
    done : dict[str, dict]
        The results that `done_already` returns.
    """
    for leftover, target in leftovers(out):
        if target in (CSV, PARQUET):  # the lock is ours
            leftover.unlink(missing_ok=True)
    table, log, numbers = Table(out, rows), Log(out), dict(done)
    for name, metrics in done.items():
        table.done(name, metrics)
    table.update()  # a log without a table would be a stranger's
    log.add(f'batch of {len(rows)} scans, {len(done)} of them done')

    def tell(event: Event) -> None:
        log.add(f'{event.kind} {event.name}' + ('' if event.kind == 'done' else f': {event.value}'))
        if event.kind == 'done':
            numbers[event.name] = event.value
            table.done(event.name, event.value)
        elif event.kind == 'failed':
            table.state(event.name, 'failed', event.value)
        else:
            table.state(event.name, 'running')
        table.update(force=False)

    missing = [row for row in rows if row.name not in done]
    jobs = [Job(row.name, row.fit_method().iterations, fit_row, (row, str(out.resolve()))) for row in missing]
    try:
        failed = run_all(jobs, runner, tell)
    except KeyboardInterrupt:
        log.add('interrupted')
        table.interrupted()
        table.update()
        raise KeyboardInterrupt('the same command goes on from here') from None
    return Outcome(numbers, failed, table.finish())
