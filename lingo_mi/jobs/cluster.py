"""Jobs on the workers of a Dask cluster, which is running already or consists of processes of this machine."""

from __future__ import annotations

import asyncio
import json
import logging
import queue
import re
import secrets
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

from lingo_mi.common.errors import InputError, brief
from lingo_mi.common.gpu import visible_gpus
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import cores
from lingo_mi.jobs.job import Event, Job, Tell
from lingo_mi.jobs.worker import describe_worker, require_fit, runs_job, work
from lingo_mi.storage.file_access import optional

PATIENCE = 60.0  # seconds: for a worker if there is none, and for jobs that are told to stop
ANSWER = 10.0  # seconds: for a scheduler
MOST_LOCAL = 1024
TIMED_OUT = TimeoutError, asyncio.TimeoutError  # one class from Python 3.11 on


@contextmanager
def opened(
    address: Any, folder: Path | None, threads: int = 0, variant: str | None = None, bar: bool = True
) -> Iterator[Cluster]:
    """Connect to a cluster. Workers that were started here end with the block.

    Parameters
    ----------
    address : str or Client
        'tcp://HOST:PORT' of a scheduler, its file FILE.json, or 'local:N', N processes of this machine; or a client of
        `distributed`, which stays open.
    folder : Path or None
        An existing folder that all workers must see; None: they need none.
    threads : int
        Dr.Jit's threads on a worker's CPU (0: all that a worker has; of local:N, its share).
    variant : str or None
        Variant of Mitsuba on the workers; None: each chooses.
    bar : bool
        Whether to show a progress bar.

    Raises
    ------
    InputError
        If no scheduler answers, or a worker cannot do the jobs.
    """
    distributed = optional('distributed', 'cluster')
    if isinstance(address, distributed.Client):
        yield Cluster(address, folder, threads, variant, bar)
        return
    if not isinstance(address, str | PathLike):
        raise InputError(f'cluster must be an address, local:N or a client of distributed, not {address!r}')
    address = str(address)
    local = re.fullmatch(r'local:(\d{1,9})', address)
    if re.match('local(:|$)', address) and not (local and 1 <= int(local[1]) <= MOST_LOCAL):
        raise InputError(f'cluster={address}: write local:N, with N workers from 1 to {MOST_LOCAL}')
    with ExitStack() as stack:
        import dask.config

        config = {
            'distributed.scheduler.worker-saturation': 1.0,  # no more than one job a worker: the others wait for whoever is free
            'distributed.deploy.lost-worker-timeout': '1 hour',  # on a busy machine, a worker takes more than 15 s to start again
        }
        stack.enter_context(dask.config.set(config))
        if local:
            count = int(local[1])
            threads = threads or max(1, cores() // count)
            where = stack.enter_context(_local(distributed, count))
        else:
            where = _answering(distributed, address)
        client = stack.enter_context(distributed.Client(where, timeout=ANSWER, set_as_default=False))
        yield Cluster(client, folder, threads, variant, bar)


def _answering(distributed: Any, address: str) -> str:
    """The address of the scheduler that answers at an address, or by its file.

    Raises
    ------
    InputError
        If none does. It is asked before there is a client, which would go on trying.
    """

    async def ask():
        async with distributed.rpc(
            where, connection_args=distributed.Security().get_connection_args('client')
        ) as server:
            if 'workers' not in await server.identity():
                raise ValueError('it is a worker')

    where = address
    try:
        if address.endswith('.json'):
            where = json.loads(Path(address).read_text())['address']
        distributed.utils.LoopRunner().run_sync(ask, callback_timeout=ANSWER)
    except FileNotFoundError:
        raise InputError(f'cluster={address}: there is no such file of a scheduler; check the path') from None
    except (OSError, ValueError, TypeError, KeyError, AttributeError, *TIMED_OUT) as error:
        wrong = f'cluster={address}: no scheduler answers ({brief(error, 120)})' if address else 'cluster is empty'
        if address.startswith(('http://', 'https://')):
            wrong = f"cluster={address}: is the dashboard's address"
        raise InputError(f"{wrong}; give the scheduler's address, such as tcp://HOST:8786, or its file") from None
    return where


@contextmanager
def workers(address: Any, path: Path) -> Iterator[Cluster]:
    """The workers that write a file together, with the variant of this process: see `opened`."""
    import mitsuba as mi

    with opened(address, path.parent, variant=mi.variant(), bar=False) as cluster:
        yield cluster


class Cluster:
    """A `Runner` on the workers of a Dask client."""

    def __init__(self, client: Any, folder: Path | None, threads: int, variant: str | None, bar: bool = True):
        self.client, self.threads, self.variant = client, threads, variant
        self.folder = None if folder is None else str(Path(folder).resolve())
        self._bar = bar
        self.require_workers()

    @property
    def dashboard(self) -> str:
        """Address of Dask's dashboard."""
        return self.client.dashboard_link

    def run(self, jobs: list[Job], tell: Tell) -> None:
        events: queue.SimpleQueue = queue.SimpleQueue()
        topic, by_name = f'lingo_mi-{secrets.token_hex(6)}', {job.name: job for job in jobs}
        futures = {}
        try:
            self.client.subscribe_topic(topic, lambda event: events.put(event[1]))
            for i, job in enumerate(jobs):
                key = f'{topic}-{i}'
                arguments = job, key, topic, self.folder, self.threads, self.variant
                future = self.client.submit(work, *arguments, key=key, pure=False, priority=-i)
                futures[job.name] = future
                future.add_done_callback(lambda future, name=job.name: events.put((name, 'ended', future)))
            with Progress('Jobs', sum(job.steps for job in jobs), shown=self._bar) as bar:
                _follow(by_name, events, tell, bar, self.require_a_worker)
            if self.client.status != 'running':
                raise InputError('the scheduler has gone; start one, and run the same command again')
            self.client.unsubscribe_topic(topic)
        except KeyboardInterrupt:
            self._stop(list(futures.values()), topic)
            raise
        except _gone() as error:
            raise InputError(
                f'the scheduler has gone ({brief(error, 100)}); start one, and run the same command again'
            ) from None
        finally:
            for future in futures.values():
                future.release()

    def _stop(self, futures: list, topic: str) -> None:
        """Cancel all jobs, and wait until no worker runs one. A job that is running stores its work first."""
        print('\nstopping after a step of every job; Ctrl-C again to stop at once', file=sys.stderr)
        self.client.cancel(futures)
        ends = time.monotonic() + PATIENCE
        while any(self.client.run(runs_job, topic, on_error='ignore').values()) and time.monotonic() < ends:
            time.sleep(0.2)

    def require_a_worker(self) -> None:
        """As `require_workers`, if all workers have gone and the scheduler has not."""
        if self.client.status == 'running' and not self.client.nthreads():
            self.require_workers()

    def require_workers(self) -> None:
        """Wait for the first worker, and check all that are there.

        Raises
        ------
        InputError
            If none comes, and if one does not answer or cannot do the jobs.
        """
        try:
            self.client.wait_for_workers(1, timeout=PATIENCE)
        except TIMED_OUT:
            raise InputError(
                f'no worker of the cluster came within {PATIENCE:.0f} s; start some, by `dask worker --nthreads 1`'
            ) from None
        for address, worker in self.client.run(describe_worker, self.folder, on_error='return').items():
            if isinstance(worker, OSError):
                raise InputError(
                    f'worker {address}: does not answer ({brief(worker, 120)}); end it, and run the same command again'
                )
            if isinstance(worker, Exception):
                raise InputError(
                    f'worker {address}: {brief(worker, 120)}; install lingo_mi {version("lingo_mi")} there'
                )
            require_fit(worker, self.folder, self.variant)


def _gone() -> tuple[type[BaseException], ...]:
    """Return the exceptions that a client raises if its scheduler no longer answers."""
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    return CommClosedError, FutureCancelledError, *TIMED_OUT


def _follow(
    jobs: dict[str, Job], events: queue.SimpleQueue, tell: Tell, bar: Progress, wait: Callable[[], object]
) -> None:
    """Pass events on until every job has ended, calling `wait` when there are none."""
    steps, running, left = dict.fromkeys(jobs, 0), set(), set(jobs)
    while left:
        try:
            name, kind, value = events.get(timeout=0.5)
        except queue.Empty:
            wait()
            continue
        if name not in left:  # sent before the end of the job, and received after it
            continue
        if kind == 'ended':
            event = _end(name, value)
            left.discard(name)
            running.discard(name)
            steps[name] = jobs[name].steps
            tell(event)
        elif kind == 'began':
            running.add(name)
            tell(Event(name, kind, value))
        elif kind == 'resumed':
            tell(Event(name, kind, value))
        elif kind == 'step':
            steps[name] = max(value, steps[name])
        bar.update(sum(steps.values()), ended=f'{len(jobs) - len(left)} of {len(jobs)}', running=len(running))


def _end(name: str, future: Any) -> Event:
    """Describe the end of a task. A worker's death is an error of a job only after several workers have died of it."""
    if future.status == 'finished':
        event = Event(*future.result())
        return event if event.kind != 'stopped' else Event(name, 'failed', 'was cancelled on its worker')
    if future.status == 'cancelled':
        return Event(name, 'failed', 'was cancelled on the cluster, or the scheduler has gone')
    error = future.exception()
    return Event(name, 'failed', brief(f'{type(error).__name__}: {error}'))


@contextmanager
def _local(distributed: Any, count: int) -> Iterator[str]:
    """A scheduler and worker processes of this machine, each with one thread for tasks and, if the machine has GPUs, one GPU."""
    gpus = visible_gpus()

    def options(i):
        env = {'CUDA_VISIBLE_DEVICES': gpus[i % len(gpus)]} if gpus else {}
        return dict(
            nthreads=1,
            memory_limit=0,  # memory is watched by `lingo_mi.common.memory`
            env=env,
            silence_logs=logging.ERROR,
            preload=['lingo_mi.jobs.worker'],
        )

    workers = {i: dict(cls=distributed.Nanny, options=options(i)) for i in range(count)}
    scheduler = dict(cls=distributed.Scheduler, options=dict(host='127.0.0.1', dashboard_address='127.0.0.1:0'))
    with distributed.SpecCluster(workers=workers, scheduler=scheduler, silence_logs=logging.ERROR) as cluster:
        yield cluster.scheduler_address
