"""The part of a job that runs on a worker of a cluster."""

from __future__ import annotations

import logging
import signal
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lingo_mi.common.errors import InputError
from lingo_mi.jobs.job import Event, Job, attempt

PAUSE = 1.0  # seconds between two reports


def dask_setup(dask_worker: Any) -> None:
    """Ignore Ctrl-C in a worker process of local:N, which Dask preloads with this module, and log nothing there.

    A terminal sends Ctrl-C to all processes. The client alone stops jobs, so that they store their work. When it ends, a worker
    would log that its scheduler is gone. The errors of jobs are sent to the client.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.disable(logging.ERROR)


def describe_worker(folder: str | None, dask_worker: Any) -> dict:
    """Version, variants, threads for tasks, address of this worker, and whether it sees a folder; called by `Client.run`."""
    import mitsuba as mi

    return dict(
        version=version('lingo_mi'),
        variants=mi.variants(),
        tasks=dask_worker.state.nthreads,
        address=dask_worker.address,
        sees=folder is None or Path(folder).is_dir(),
    )


def runs_job(topic: str, dask_worker: Any) -> bool:
    """Return whether this worker runs a job of a topic, also a cancelled one; called by `Client.run`."""
    return any(str(task.key).startswith(topic) for task in dask_worker.state.executing)


def require_fit(worker: dict, folder: str | None, variant: str | None) -> None:
    """Raises InputError if a worker, by what `describe_worker` says, cannot do the jobs.

    Parameters
    ----------
    variant : str or None
        Variant of Mitsuba that it must have; None: it chooses.
    """
    who = f'worker {worker["address"]}'
    if worker['version'] != (ours := version('lingo_mi')):
        raise InputError(f'{who}: has lingo_mi {worker["version"]}, not {ours}; install the same there')
    if variant is not None and variant not in worker['variants']:
        raise InputError(f'{who}: its Mitsuba has no variant {variant}; install the same Mitsuba there')
    if worker['tasks'] != 1:
        raise InputError(
            f'{who}: runs {worker["tasks"]} tasks at once, which would share one Dr.Jit; start it by `dask worker --nthreads 1`'
        )
    if not worker['sees']:
        raise InputError(
            f'{who}: does not see the folder {folder}; choose one on a file system that all machines share'
        )


def work(job: Job, key: str, topic: str, folder: str | None, threads: int, variant: str | None) -> Event:
    """Run a job in a task of Dask; returns its last event.

    Parameters
    ----------
    key : str
        Key of the task.
    topic : str
        Topic of the events that it sends.
    folder : str or None
        A folder that all workers share; None: none.
    threads : int
        Dr.Jit's threads on the CPU; 0: as many as it has.
    """
    from distributed import get_worker

    worker = get_worker()
    worker.log_event(topic, Event(job.name, 'began', worker.address))
    reported = time.monotonic()

    def report(done, **_):
        nonlocal reported
        if time.monotonic() - reported > PAUSE:
            reported = time.monotonic()
            worker.log_event(topic, Event(job.name, 'step', done))
            task = worker.state.tasks.get(key)
            if task is None or task.state == 'cancelled':  # nobody waits for it any more
                raise KeyboardInterrupt

    try:
        prepare(worker, folder, threads, variant)
        event = attempt(job, report, lambda event: worker.log_event(topic, event))
        return event._replace(value=f'{event.value} (worker {worker.address})') if event.kind == 'failed' else event
    except InputError as error:
        return Event(job.name, 'failed', str(error))
    except KeyboardInterrupt:
        return Event(job.name, 'stopped')


def prepare(worker: Any, folder: str | None, threads: int, variant: str | None) -> None:
    """Check this worker, and choose its variant and its threads; arguments as for `work`.

    Raises
    ------
    InputError
        If it cannot do the jobs. The line names the worker.
    """
    require_fit(describe_worker(folder, worker), folder, variant)
    # Dask's profiler may be the last to hold a task's frame, and free its arrays in the worker's main thread. That waits for
    # Dr.Jit's lock while it holds Python's, and the task's thread may wait for Python's while it holds Dr.Jit's.
    if profile := worker.periodic_callbacks.get('profile'):
        worker.loop.add_callback(profile.stop)
    try:
        _prepare(threads, variant)
    except InputError as error:
        raise InputError(f'worker {worker.address}: {error}') from None


def _prepare(threads: int, variant: str | None) -> None:
    import mitsuba as mi

    from lingo_mi.common.runtime import ensure_variant, use_threads, use_variant

    if variant is None:
        ensure_variant()
    elif mi.variant() != variant:
        use_variant(variant)
    if threads:
        use_threads(threads)
