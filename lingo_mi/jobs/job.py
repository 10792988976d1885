"""A job, its messages, and its end."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from lingo_mi.common.errors import InputError, brief


@dataclass(frozen=True)
class Job:
    """One piece of work, which can be sent to another machine.

    Parameters
    ----------
    name : str
        Name of the job, another one for each.
    steps : int
        Steps that it reports, for the progress.
    function : callable
        A function of a module, called as function(*arguments, report=report). It calls report(steps done, **fields) between its
        steps, and a KeyboardInterrupt there says that it must stop. The next call finds what it has stored by then.
    arguments : tuple
        Arguments that pickle.
    """

    name: str
    steps: int
    function: Callable[..., Any]
    arguments: tuple = ()


class Event(NamedTuple):
    """Message about a job.

    Parameters
    ----------
    name : str
        Name of the job.
    kind : str
        'began'; 'resumed', if its first step is not the first of all; 'step'; and at the end 'done', 'failed', or 'stopped':
        interrupted, and to be gone on with.
    value
        Began: where (text); resumed, step: the steps done; done: what the function returned; failed: one line.
    """

    name: str
    kind: str
    value: Any = None


Tell = Callable[[Event], object]


class Runner(Protocol):
    """Runs jobs, telling of each; every job ends in 'done' or 'failed'. Raises KeyboardInterrupt after Ctrl-C."""

    def run(self, jobs: list[Job], tell: Tell) -> None: ...


def attempt(job: Job, report: Callable[..., None], tell: Tell) -> Event:
    """Run a job here and return its last event, 'done' or 'failed'. Errors that are not an `InputError` are also printed with a
    traceback.

    Parameters
    ----------
    report : callable
        Called between steps, as the job's own.
    tell : Tell
        Called with 'resumed', if the job goes on from what is stored.
    """
    first = True

    def watch(done, **fields):
        nonlocal first
        if first and done > 1:
            tell(Event(job.name, 'resumed', done))
        first = first and not done
        report(done, **fields)

    try:
        return Event(job.name, 'done', job.function(*job.arguments, report=watch))
    except (InputError, OSError) as error:
        return Event(job.name, 'failed', brief(error))
    except MemoryError as error:
        return Event(job.name, 'failed', f'not enough memory ({brief(error, 200)})')
    except Exception as error:  # one job failed: the others are worth having
        traceback.print_exc()
        return Event(job.name, 'failed', brief(f'{type(error).__name__}: {error}'))


def run_or_refuse(jobs: list[Job], runner: Runner, tell: Tell = lambda _: None) -> None:
    """`run_all` for jobs that are of use only together.

    Raises
    ------
    InputError
        For the first job that failed twice, with its name and line.
    """
    if failed := run_all(jobs, runner, tell):
        raise InputError(next(f'{name}: {line}' for name, line in failed.items()))


def run_all(jobs: list[Job], runner: Runner, tell: Tell) -> dict[str, str]:
    """Run all jobs, and those that failed once more when all others have ended; the one line of each that failed twice, by name.

    Parameters
    ----------
    tell : Tell
        Called with every event, in this thread. After a first 'failed' the job begins again.
    """
    failed: dict[str, str] = {}

    def listen(event: Event) -> None:
        if event.kind == 'failed':
            failed[event.name] = event.value
        tell(event)

    runner.run(jobs, listen)
    if again := [job for job in jobs if job.name in failed]:
        failed.clear()
        runner.run(again, listen)
    return failed
