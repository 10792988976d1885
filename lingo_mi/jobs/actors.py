"""An object that stays on the workers of a Dask cluster, and calls that are divided among them."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from typing import Any

from lingo_mi.common.errors import InputError, brief
from lingo_mi.jobs.cluster import TIMED_OUT, Cluster
from lingo_mi.jobs.worker import prepare

ROUNDS = 4  # of one call: workers may die in all but the last


class Actors:
    """A copy of an object on each worker, which Dask calls an actor. It is made when a call needs it.

    If a worker dies, others do its part of the call. A worker that comes later takes part from the next call on.

    Parameters
    ----------
    cluster : Cluster
        The workers.
    resident
        The object, which pickles.
    """

    def __init__(self, cluster: Cluster, resident: Any):
        self._cluster, self._resident = cluster, resident
        self._actors: dict[str, tuple[Any, Any]] = {}  # Dask's future, which keeps it alive, and the actor, by address

    def divided(self, method: str, items: Sequence[Any], *arguments: Any) -> list[Any]:
        """Call `resident.method(part, *arguments)` on several workers at once, each with a part of the items.

        Returns
        -------
        list
            The results. Every item was in the part of exactly one of them.

        Raises
        ------
        InputError
            If no worker comes, if one cannot do the work, and if workers die again and again. Other errors are the method's.
        """
        from distributed import CancelledError
        from distributed.scheduler import KilledWorker

        lost = OSError, RuntimeError, KilledWorker, CancelledError, *TIMED_OUT
        results, left, reason = [], list(items), ''
        with self._cluster.client.as_current():  # where actors look for their client
            for _ in range(ROUNDS):
                todo, left = left, []
                try:
                    actors = self._ready(len(todo))
                except lost as error:
                    left, reason = todo, brief(error, 120)
                    continue
                parts = [(a, todo[i :: len(actors)]) for i, a in enumerate(actors)]
                calls = [(a, part, _called(actors[a], method, part, *arguments)) for a, part in parts]
                for address, part, result in calls:
                    try:
                        results.append(result())
                    except lost as error:
                        left, reason = left + part, brief(error, 120)
                        del self._actors[address]
                if not left:
                    return results
        raise InputError(
            f'workers of the cluster, or its scheduler, have gone ({reason}); start them, and go on with resume=True'
        )

    def _ready(self, count: int) -> dict[str, Any]:
        """Return `count` actors, or one for each worker if these are fewer, by address. Missing ones are made."""
        from distributed.protocol.pickle import dumps

        client = self._cluster.client
        self._cluster.require_a_worker()
        there = client.nthreads()
        self._actors = {a: pair for a, pair in self._actors.items() if a in there and pair[0].status == 'finished'}
        chosen = sorted(there, key=lambda a: a not in self._actors)[:count]
        if missing := [a for a in chosen if a not in self._actors]:
            [resident] = client.scatter([dumps(self._resident)], hash=False)
            arguments = resident, self._cluster.threads, self._cluster.variant
            # Other workers: else it would wait for ever for one that has just died.
            futures = {
                a: client.submit(_Actor, *arguments, workers=[a], allow_other_workers=True, actor=True) for a in missing
            }
            self._actors |= {a: (future, future.result()) for a, future in futures.items()}
        return {a: self._actors[a][1] for a in chosen}


def _called(actor: Any, *arguments: Any) -> Callable[[], Any]:
    """A call that has begun, whose result waits for its end, and raises what went wrong."""
    try:
        return actor.call(*arguments).result
    except RuntimeError as error:  # the actor has gone
        reason = error

    def fail():
        raise reason

    return fail


class _Actor:
    """The object on a worker, whose variant and threads are set before the first call."""

    def __init__(self, pickled: bytes, threads: int, variant: str | None):
        self._pickled, self._threads, self._variant, self._resident = pickled, threads, variant, None

    def call(self, method: str, part: Sequence[Any], *arguments: Any) -> Any:
        from distributed import get_worker

        try:
            if self._resident is None:  # made here, since Dask calls an actor in another thread than it makes it
                self._resident = _prepared(self._pickled, self._threads, self._variant)
                self._pickled = b''
            return getattr(self._resident, method)(part, *arguments)
        except (OSError, RuntimeError, MemoryError) as error:  # the client would take the first two for a lost worker
            reason = brief(f'{type(error).__name__}: {error}', 160)
            raise InputError(f'worker {get_worker().address}: {reason}') from error


def _prepared(pickled: bytes, threads: int, variant: str | None) -> Any:
    from distributed import get_worker

    worker = get_worker()
    prepare(worker, None, threads, variant)
    try:
        return pickle.loads(pickled)
    except ImportError as error:
        raise InputError(f'worker {worker.address}: {error}; install it there, too') from None
