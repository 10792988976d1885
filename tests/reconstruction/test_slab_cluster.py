"""Slabs on the workers of a Dask cluster: the volume of one process to the last bit, also where a worker is killed."""

import errno
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

import lingo_mi as lm
from helpers.dask_cluster import cluster, wait_until
from lingo_mi.cli import reconstruct
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.files.slabs import SharedZarr
from lingo_mi.files.volumes import read_volume
from lingo_mi.files.zarr_views import ZarrViews
from lingo_mi.fitting.slab_cluster import voxelize_on
from lingo_mi.geometry import Grid
from lingo_mi.jobs.cluster import Cluster, opened
from lingo_mi.jobs.in_process import InProcess
from lingo_mi.reconstruction import ASDPOCS, FDK, OSSART, SART
from lingo_mi.reconstruction.run import run_in_slabs
from lingo_mi.storage.file_access import writing

pytest.importorskip('distributed')
zarr = pytest.importorskip('zarr')
slab_faults = pytest.importorskip('helpers.slab_faults')  # imports zarr
SHAPE = 16, 12, 150  # three slabs, the last of which is thinner and of an even number of slices


@pytest.fixture(scope='module')
def scan():
    geometry = lm.Geometry.cone(
        DSO=600, DSD=800, nDetector=(64, 24), dDetector=(5.0, 3.0), grid=Grid(SHAPE, 2.0), angles=np.linspace(0, 6, 9)
    )
    return lm.simulate(np.random.default_rng(0).random(SHAPE, np.float32), geometry, progress=False).train


def levels(path):
    """The arrays of an OME-Zarr, the finest first."""
    group = zarr.open_group(str(path), mode='r')
    return [np.asarray(group[str(i)]) for i in range(len(list(group.array_keys())))]


def require_same(actual, wanted):
    assert sorted(p.name for p in actual.iterdir()) == sorted(p.name for p in wanted.iterdir())
    for a, b in zip(levels(actual), levels(wanted), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    'algorithm', [FDK(), OSSART(niter=2, blocksize=4), ASDPOCS(niter=1, tviter=2, blocksize=5)], ids=lambda a: a.name
)
def test_the_volume_of_one_process(scan, tmp_path, algorithm):
    """The same jobs run here, in this process."""
    lm.reconstruct(scan, algorithm, slab=64, out=tmp_path / 'one.ome.zarr', progress=False)
    steps = []
    run_in_slabs(scan, algorithm, tmp_path / 'many.ome.zarr', 64, lambda done, *_: steps.append(done), InProcess())
    require_same(tmp_path / 'many.ome.zarr', tmp_path / 'one.ome.zarr')
    assert steps[-1] == algorithm.slab_steps(scan, 64) and steps == sorted(steps)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['many.ome.zarr', 'one.ome.zarr']


@pytest.mark.parametrize('algorithm', [FDK(), ASDPOCS(niter=1, tviter=1, blocksize=3)], ids=lambda a: a.name)
def test_stored_views(scan, tmp_path, algorithm, monkeypatch):
    """Views are read some at a time, never all, by one process and by workers; a missing chunk is named."""
    few = replace(scan, geometry=scan.geometry.on(Grid((8, 8, 80), (4.0, 3.0, 3.75))))  # two slabs
    write_scan(tmp_path / 'scan.zarr', few, 'zarr')
    stored, read = read_scan(tmp_path / 'scan.zarr').train, ZarrViews.__getitem__
    numbers = []
    monkeypatch.setattr('lingo_mi.scan.PIECE', 4)
    monkeypatch.setattr('lingo_mi.inspection.measure.PIECE', 4)
    monkeypatch.setattr(ZarrViews, '__getitem__', lambda self, i: numbers.append(len(self.numbers[i])) or read(self, i))
    run_in_slabs(few, algorithm, tmp_path / 'wanted.ome.zarr', 64)
    assert not numbers
    lm.reconstruct(stored, algorithm, slab=64, out=tmp_path / 'one.ome.zarr', progress=False)
    run_in_slabs(stored, algorithm, tmp_path / 'many.ome.zarr', 64, runner=InProcess())
    for name in 'one.ome.zarr', 'many.ome.zarr':
        require_same(tmp_path / name, tmp_path / 'wanted.ome.zarr')
    assert 0 < max(numbers) <= 4 and 'projections' not in vars(stored)
    (tmp_path / 'scan.zarr' / 'c' / '0' / '0' / '0').unlink()
    with pytest.raises(InputError, match='scan.zarr: lacks a chunk of the views 0 to 3'):
        run_in_slabs(stored, algorithm, tmp_path / 'none.ome.zarr', 64, runner=InProcess())
    assert not (tmp_path / 'none.ome.zarr').exists()


def test_invalid_pixels(scan, tmp_path):
    valid = np.ones(scan.projections.shape, bool)
    valid[:, 10:20, 5:9] = False
    holed, how = replace(scan, valid=valid), SART(niter=1)
    lm.reconstruct(holed, how, slab=64, out=tmp_path / 'one.ome.zarr', progress=False)
    run_in_slabs(holed, how, tmp_path / 'many.ome.zarr', 64, runner=InProcess())
    require_same(tmp_path / 'many.ome.zarr', tmp_path / 'one.ome.zarr')


STEPS = [
    (FDK(), '_fdk_slab', ''),
    (OSSART(niter=2, blocksize=4), '_slab_work', '2-update'),
    (OSSART(niter=1, blocksize=9), '_deliver_slab', ''),
    (ASDPOCS(niter=1, tviter=2, blocksize=5), '_slab_work', '0-update'),
    (ASDPOCS(niter=1, tviter=2, blocksize=5), '_slab_work', '3-descend'),
]


@pytest.mark.parametrize('algorithm, function, step', STEPS, ids=[f'{a.name}{f}{s}' for a, f, s in STEPS])
def test_a_full_disk(scan, tmp_path, monkeypatch, algorithm, function, step):
    """One line says which slab and file; nothing is written. The same call makes only the slab of this step that is missing."""
    from lingo_mi.reconstruction import slab_cluster

    out, folder, made = tmp_path / 'a.ome.zarr', tmp_path / 'a.ome.zarr.slabs', []
    number = {'_slab_work': lambda task, part: part}.get(function, lambda target, part: part[0] // 64)
    make = getattr(slab_cluster, function)

    def run(fails):
        made.clear()

        def job(first, part, *more, **options):
            if getattr(first, 'step', '') == step:
                if number(first, part) == 1 and fails:
                    with writing(folder):
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder / 'odd.f32'))
                made.append(number(first, part))
            make(first, part, *more, **options)

        monkeypatch.setattr(slab_cluster, function, job)
        run_in_slabs(scan, algorithm, out, 64, runner=InProcess())

    with pytest.raises(InputError, match=r'^slab 1: .*odd.f32: cannot be written \(No space left') as error:
        run(fails=True)
    assert '\n' not in str(error.value) and [p.name for p in tmp_path.iterdir()] == [folder.name]
    assert sorted(made) == [0, 2]
    with pytest.raises(InputError, match='holds a reconstruction of other data or with other options'):
        run_in_slabs(scan, replace(algorithm, **OTHER[algorithm.name]), out, 64, runner=InProcess())
    run(fails=False)
    assert made == [1] and [p.name for p in tmp_path.iterdir()] == [out.name]
    run_in_slabs(scan, algorithm, tmp_path / 'wanted.ome.zarr', 64)
    require_same(out, tmp_path / 'wanted.ome.zarr')


OTHER = {'fdk': dict(filter='hann'), 'os-sart': dict(lmbda=0.5), 'asd-pocs': dict(alpha=0.1)}


def test_a_volume_of_a_fit_that_was_stopped(scan, tmp_path, monkeypatch):
    fit = lm.fit(scan, 'fast', iterations=2, n_points=50, progress=False)
    out, write, made = tmp_path / 'a.ome.zarr', SharedZarr.write, []

    def full(target, begin, slab):
        if begin == 64:
            raise InputError('no room')
        made.append(begin)
        write(target, begin, slab)

    def save():
        made.clear()
        voxelize_on(InProcess(), fit, fit.geometry.grid, 64, out)

    monkeypatch.setattr(SharedZarr, 'write', full)
    with pytest.raises(InputError, match='slab 1: no room'):
        save()
    monkeypatch.undo()
    monkeypatch.setattr(SharedZarr, 'write', lambda *a: made.append(a[1]) or write(*a))
    save()
    assert made == [64] and [p.name for p in tmp_path.iterdir()] == [out.name]
    fit.save_volume(tmp_path / 'wanted.ome.zarr', slab=64)
    require_same(out, tmp_path / 'wanted.ome.zarr')


@pytest.fixture(scope='module')
def client(tmp_path_factory):
    """A client of local:2, two processes that are replaced when they die."""
    with opened('local:2', tmp_path_factory.mktemp('workers'), variant=mi.variant(), bar=False) as cluster:
        yield cluster.client


@pytest.fixture
def workers(client):
    """The client; after the test its workers work as before."""
    yield client
    client.run(slab_faults.undo)


@pytest.mark.thorough
@pytest.mark.posix
@pytest.mark.parametrize(
    'algorithm, at',
    [
        pytest.param(OSSART(niter=2, blocksize=5), 3, id='os-sart'),
        pytest.param(ASDPOCS(niter=1, tviter=3, blocksize=5), 2, id='asd-pocs, a sweep'),
        pytest.param(ASDPOCS(niter=1, tviter=3, blocksize=5), 8, id='asd-pocs, a descent'),
    ],
)
def test_a_worker_dies_in_a_slab(scan, tmp_path, workers, algorithm, at):
    """It has written half of the slab. Another worker takes its place, and the volume is the same as of one process."""
    run_in_slabs(scan, algorithm, tmp_path / 'one.ome.zarr', 64)
    before = set(workers.run(os.getpid).values())
    workers.run(slab_faults.die_in_slab, at, tmp_path / 'died')
    lm.reconstruct(scan, algorithm, out=tmp_path / 'many.ome.zarr', cluster=workers, progress=False)
    assert (tmp_path / 'died').exists()
    require_same(tmp_path / 'many.ome.zarr', tmp_path / 'one.ome.zarr')
    wait_until(lambda: len(workers.run(os.getpid)) == 2)
    assert set(workers.run(os.getpid).values()) != before


@pytest.mark.thorough
@pytest.mark.posix
@pytest.mark.parametrize(
    'algorithm', [OSSART(niter=2, blocksize=5), ASDPOCS(niter=1, tviter=1, blocksize=5), FDK()], ids=lambda a: a.name
)
def test_interrupted(scan, tmp_path, workers, algorithm):
    """After Ctrl-C no file is half written, and no worker has a task; the same call goes on."""
    run_in_slabs(scan, algorithm, tmp_path / 'one.ome.zarr', 64)
    workers.run(slab_faults.slow_slabs, 1.0, tmp_path / 'began')
    home = tmp_path / 'home'
    home.mkdir()

    def interrupt():
        wait_until((tmp_path / 'began').exists)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        lm.reconstruct(scan, algorithm, out=home / 'many.ome.zarr', cluster=workers, progress=False)
    thread.join()
    assert not any(workers.run(tasks_of_worker).values()) and not workers.run_on_scheduler(tasks_of_scheduler)
    assert [p.name for p in home.iterdir()] == ['many.ome.zarr.slabs']
    assert not list(home.rglob('.lingo_mi*'))
    workers.run(slab_faults.undo)
    lm.reconstruct(scan, algorithm, out=home / 'many.ome.zarr', cluster=workers, progress=False)
    require_same(home / 'many.ome.zarr', tmp_path / 'one.ome.zarr')
    assert [p.name for p in home.iterdir()] == ['many.ome.zarr']


@pytest.mark.thorough
@pytest.mark.posix
def test_interrupted_in_a_terminal(scan, tmp_path):
    """Ctrl-C reaches the workers of local:N as well. They print nothing."""
    write_scan(tmp_path / 'scan.zarr', scan, 'zarr')
    home, state = tmp_path / 'home', tmp_path / 'home' / 'a.ome.zarr.slabs' / 'state.json'
    home.mkdir()
    words = 'reconstruct ../scan.zarr --algorithm os-sart -D niter=500 --cluster local:2 --out a.ome.zarr'
    command = [sys.executable, '-m', 'lingo_mi', *words.split(), '--variant', mi.variant()]
    process = subprocess.Popen(command, cwd=home, stdout=-1, stderr=-1, text=True, start_new_session=True)
    wait_until(lambda: process.poll() is not None or state.exists() and '"updates": 0' not in state.read_text())
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130 and 'Traceback' not in err, err
    assert [p.name for p in home.iterdir()] == ['a.ome.zarr.slabs'] and not list(home.rglob('.lingo_mi*'))


@pytest.mark.thorough
@pytest.mark.posix
def test_the_disk_of_the_workers_is_full(scan, tmp_path, workers):
    """One line names the slab, the file and the worker. What other slabs have written stays."""
    out, folder = tmp_path / 'many.ome.zarr', tmp_path / 'many.ome.zarr.slabs'
    workers.run(slab_faults.full_disk, 64)
    words = r'^slab 1: .*many.ome.zarr.slabs/growing.ome.zarr: cannot be written \(No space left.*\(worker tcp://'
    with pytest.raises(InputError, match=words) as error:
        lm.reconstruct(scan, FDK(), out=out, cluster=workers, progress=False)
    assert '\n' not in str(error.value) and [p.name for p in tmp_path.iterdir()] == [folder.name]
    halves = sorted((folder / 'growing.ome.zarr' / 'halves').iterdir())
    assert [file.name for file in halves] == ['00000000.npy', '00000128.npy']
    workers.run(slab_faults.undo)
    again = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Cluster, 'run', lambda self, jobs, tell, run=Cluster.run: again.extend(jobs) or run(self, jobs, tell)
        )
        lm.reconstruct(scan, FDK(), out=out, cluster=workers, progress=False)
    assert [job.name for job in again] == ['slab 1']
    run_in_slabs(scan, FDK(), tmp_path / 'one.ome.zarr', 64)
    require_same(out, tmp_path / 'one.ome.zarr')


def tasks_of_worker(dask_worker):
    return len(dask_worker.state.executing)


def tasks_of_scheduler(dask_scheduler):
    return len(dask_scheduler.tasks)


@pytest.mark.thorough
def test_a_worker_is_killed(scan, tmp_path):
    """One of three real workers dies in the middle. Then an open client makes a fit's volume."""
    import distributed

    how, out, work = OSSART(niter=6, blocksize=3), tmp_path / 'many.ome.zarr', tmp_path / 'many.ome.zarr.slabs'
    lm.reconstruct(scan, how, slab=64, out=tmp_path / 'one.ome.zarr', progress=False)
    with cluster(tmp_path, workers=3) as (address, processes):
        numbers = list(processes().values())

        def kill():
            wait_until(
                lambda: (work / 'state.json').exists() and '"updates": 0' not in (work / 'state.json').read_text()
            )
            os.kill(numbers[0], signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        assert lm.reconstruct(scan, how, out=out, cluster=address, progress=False) == out
        killer.join()
        assert len(processes()) == 2
        require_same(out, tmp_path / 'one.ome.zarr')
        fit = lm.fit(scan, 'fast', iterations=5, n_points=100, progress=False)
        fit.save_volume(tmp_path / 'one_fit.ome.zarr', slab=64)
        with distributed.Client(scheduler_file=str(address), set_as_default=False) as client:
            fit.save_volume(tmp_path / 'fit.ome.zarr', slab=64, cluster=client)
        require_same(tmp_path / 'fit.ome.zarr', tmp_path / 'one_fit.ome.zarr')
        assert read_volume(tmp_path / 'fit.ome.zarr').data.shape == SHAPE


def test_bad_input(scan, tmp_path):
    def refused(words, algorithm=FDK(), **options):  # noqa: B008
        with pytest.raises(InputError, match=words):
            lm.reconstruct(scan, algorithm, progress=False, **options)
        assert list(tmp_path.iterdir()) == []

    out = tmp_path / 'a.ome.zarr'
    refused('give out=FILE', cluster='local:2')
    refused('workers of a cluster write parts of one .ome.zarr', cluster='local:2', out=tmp_path / 'a.nii.gz')
    refused('multiple of 64 slices on a cluster, not 50: give slab=64', cluster='local:2', out=out, slab=50)
    refused('cgls needs the whole volume: leave out slab and cluster', lm.CGLS(niter=1), cluster='local:2', out=out)
    refused('write local:N', cluster='local:0', out=out)
    refused('no scheduler answers', cluster='tcp://127.0.0.1:1', out=out)
    refused('there is no such file of a scheduler', cluster=str(tmp_path / 'none.json'), out=out)
    refused('cluster must be an address', cluster=3, out=out)


@pytest.mark.parametrize('words, message', [
    ('sart --start fit --cluster local:2', 'a volume in slabs starts empty: leave out --start, or --cluster'),
    ('cgls --cluster local:2', '--algorithm cgls needs the whole volume: leave out --cluster, or'),
    ('cgls --slab 64 --cluster local:2', 'leave out --slab and --cluster, or'), ('fdk --slab 0', 'from 1 on, not 0'),
])  # fmt: skip
def test_options_that_were_given(words, message):
    args = reconstruct.parser().parse_args(['walnut', '--out', 'a.ome.zarr', '--algorithm', *words.split()])
    with pytest.raises(InputError, match=message):
        reconstruct.check_arguments(args)
