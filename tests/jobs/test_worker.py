"""Workers that cannot do a job: one line that names them."""

import errno
import importlib
import os
import time
from pathlib import Path

import mitsuba as mi
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.jobs.cluster import Cluster
from lingo_mi.jobs.job import Job, run_or_refuse
from lingo_mi.jobs.worker import require_fit
from lingo_mi.storage.file_access import writing

distributed = pytest.importorskip('distributed')


@pytest.fixture(scope='module')
def client():
    """A client of two workers that are threads of this process."""
    options = dict(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0)
    with distributed.LocalCluster(**options) as local, distributed.Client(local, set_as_default=False) as client:
        yield client


def addresses(client):
    return [worker['id'] for worker in client.scheduler_info()['workers'].values()]


def test_workers_that_do_not_fit():
    good = dict(version='0', variants=['llvm_ad_mono'], tasks=1, address='tcp://10.0.0.7:1', sees=True)

    def refused(words, variant='llvm_ad_mono', **other):
        with pytest.raises(InputError, match=f'^worker tcp://10.0.0.7:1: {words}'):
            require_fit(good | other, '/shared', variant)

    refused('has lingo_mi 0, not .*; install the same there')
    from importlib.metadata import version

    good['version'] = version('lingo_mi')
    require_fit(good, '/shared', 'llvm_ad_mono')
    require_fit(good, '/shared', None)
    refused('its Mitsuba has no variant cuda_ad_mono; install', 'cuda_ad_mono')
    refused('runs 2 tasks at once', tasks=2)
    refused('does not see the folder /shared; choose', sees=False)


def fills_up(folder, *, report):
    report(0)
    with writing(folder):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder / 'odd.f32'))


def test_a_disk_that_fills(client, tmp_path):
    cluster = Cluster(client, tmp_path, 0, mi.variant(), bar=False)
    with pytest.raises(
        InputError, match=r'^slab 3: .*odd.f32: cannot be written \(No space left.*\(worker inproc://'
    ) as error:
        run_or_refuse([Job('slab 3', 1, fills_up, (tmp_path,))], cluster)
    assert '\n' not in str(error.value)


def test_before_any_work(client, tmp_path):
    with pytest.raises(InputError, match='^worker inproc://.*no variant no_such'):
        Cluster(client, tmp_path, 0, 'no_such')
    with pytest.raises(InputError, match='^worker inproc://.*does not see the folder'):
        Cluster(client, Path(tmp_path / 'elsewhere'), 0, None)


def test_a_worker_without_the_backend(client, tmp_path, monkeypatch):
    """It has the variant, but no library or GPU for it."""
    from lingo_mi.jobs import worker

    def prepare(*_):
        raise InputError('variant cuda_ad_mono: no NVIDIA GPU can be used')

    monkeypatch.setattr(worker, '_prepare', prepare)
    cluster = Cluster(client, tmp_path, 0, mi.variant(), bar=False)
    with pytest.raises(InputError, match='^slab 0: worker inproc://.*: variant cuda_ad_mono: no NVIDIA GPU'):
        run_or_refuse([Job('slab 0', 1, fills_up, (tmp_path,))], cluster)


def test_a_worker_that_hangs(client, monkeypatch):
    from distributed.comm.core import CommClosedError

    monkeypatch.setattr(client, 'run', lambda *_, **__: {'tcp://10.0.0.7:1': CommClosedError('Stream is closed')})
    with pytest.raises(InputError, match=r'^worker tcp://10.0.0.7:1: does not answer \(.*; end it, and run the same'):
        Cluster(client, None, 0, None)


class Lacking:
    """A function that a worker cannot read."""

    def __reduce__(self):
        return importlib.import_module, ('no_such_module',)


def test_a_worker_that_lacks_the_package(client, monkeypatch):
    monkeypatch.setattr('lingo_mi.jobs.cluster.describe_worker', Lacking())
    with pytest.raises(
        InputError, match='^worker inproc://.*No module named .*no_such_module.*; install lingo_mi .* there'
    ):
        Cluster(client, None, 0, None)


def profiled(dask_worker):
    return dask_worker.periodic_callbacks['profile'].is_running()


def test_frames_are_not_profiled(client):
    """The profiler would free a task's arrays in another thread, which can wait for ever."""
    Cluster(client, None, 0, mi.variant(), bar=False).run([Job(str(i), 1, waits) for i in range(4)], lambda _: None)
    assert not any(client.run(profiled).values())


def waits(*, report):
    time.sleep(0.5)


def test_the_last_worker_goes(monkeypatch):
    options = dict(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=':0', memory_limit=0)
    with distributed.LocalCluster(**options) as local, distributed.Client(local, set_as_default=False) as client:
        cluster = Cluster(client, None, 0, mi.variant(), bar=False)
        monkeypatch.setattr('lingo_mi.jobs.cluster.PATIENCE', 0.5)

        def leave(event):
            if event.kind == 'began':
                client.retire_workers(client.nthreads())

        with pytest.raises(InputError, match=r'^no worker of the cluster came within .*; start some'):
            cluster.run([Job(str(i), 1, waits) for i in range(3)], leave)
