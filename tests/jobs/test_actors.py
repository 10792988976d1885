"""Objects that stay on workers: every item is done once, also where a worker goes."""

import mitsuba as mi
import pytest

from helpers.dask_cluster import wait_until
from lingo_mi.common.errors import InputError
from lingo_mi.jobs import actors as actors_module
from lingo_mi.jobs.actors import Actors
from lingo_mi.jobs.cluster import Cluster

distributed = pytest.importorskip('distributed')


@pytest.fixture
def local():
    """A cluster of two workers that are threads of this process."""
    options = dict(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0)
    with distributed.LocalCluster(**options) as local, distributed.Client(local, set_as_default=False) as client:
        yield Cluster(client, None, 0, mi.variant(), bar=False)


class Squares:
    """An object on each worker."""

    def squares(self, items, offset):
        return [(i, i * i + offset) for i in items], id(self), distributed.get_worker().address

    def refuses(self, items):
        raise InputError(f'cannot do {items}')

    def exhausts(self, items):
        raise RuntimeError('jit_malloc(): out of memory')


def leave(dask_worker):
    dask_worker.loop.add_callback(dask_worker.close)


def done(results):
    return sorted(pair for pairs, _, _ in results for pair in pairs)


def test_calls_are_divided(local):
    """Workers that keep the object share the calls, and fewer do when one has gone."""
    actors, wanted = Actors(local, Squares()), [(i, i * i + 7) for i in range(5)]
    first, second = (actors.divided('squares', range(5), 7) for _ in range(2))
    assert done(first) == done(second) == wanted
    assert {object_id for _, object_id, _ in first} == {object_id for _, object_id, _ in second}
    assert len({address for *_, address in second}) == 2
    assert len(actors.divided('squares', [3], 7)) == 1
    with pytest.raises(InputError, match='cannot do'):
        actors.divided('refuses', range(2))
    local.client.run(leave, workers=[first[0][2]])
    wait_until(lambda: len(local.client.nthreads()) == 1)
    (result,) = actors.divided('squares', range(5), 7)
    assert done([result]) == wanted and result[2] == first[1][2]


def test_a_part_is_done_again(local):
    """Only the part of a lost worker is done again."""
    actors, lost = Actors(local, Squares()), []
    ready = actors._ready

    class Gone:
        def call(self, method, part, *arguments):
            lost.append(part)
            raise RuntimeError('Worker holding Actor was lost')

    def ready_but_one(count):
        (address, actor), *others = ready(count).items()
        return {address: actor if lost else Gone(), **dict(others)}

    actors._ready = ready_but_one
    assert done(actors.divided('squares', range(5), 0)) == [(i, i * i) for i in range(5)] and lost == [[0, 2, 4]]


def test_workers_that_are_always_lost(local, monkeypatch):
    monkeypatch.setattr(actors_module, '_called', lambda *_: lost)
    with pytest.raises(InputError, match=r'have gone \(Unable to contact\); start them, and go on with resume=True'):
        Actors(local, Squares()).divided('squares', range(5), 7)


def lost():
    raise OSError('Unable to contact')


def test_an_error_of_a_worker(local):
    """It names the worker, which has not gone."""
    with pytest.raises(InputError, match=r'^worker inproc://.*: RuntimeError: jit_malloc\(\): out of memory$'):
        Actors(local, Squares()).divided('exhausts', range(5))
