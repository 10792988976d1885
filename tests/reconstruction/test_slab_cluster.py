"""Slabs on the workers of a Dask cluster: the volume of one process to the last bit, also where a worker is killed."""

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

import lingo_mi as lm
from helpers.dask_cluster import cluster, wait_until
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.files.volumes import read_volume
from lingo_mi.files.zarr_views import ZarrViews
from lingo_mi.geometry import Grid
from lingo_mi.jobs.in_process import InProcess
from lingo_mi.reconstruction import ASDPOCS, FDK, OSSART, SART
from lingo_mi.reconstruction.run import run_in_slabs

pytest.importorskip('distributed')
zarr = pytest.importorskip('zarr')
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
    """By the same jobs, in this process."""
    lm.reconstruct(scan, algorithm, slab=64, out=tmp_path / 'one.ome.zarr', progress=False)
    steps = []
    run_in_slabs(scan, algorithm, tmp_path / 'many.ome.zarr', 64, lambda done, *_: steps.append(done), InProcess())
    require_same(tmp_path / 'many.ome.zarr', tmp_path / 'one.ome.zarr')
    assert steps[-1] == algorithm.slab_steps(scan, 64) and steps == sorted(steps)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['many.ome.zarr', 'one.ome.zarr']


@pytest.mark.parametrize('algorithm', [FDK(), ASDPOCS(niter=1, tviter=1, blocksize=3)], ids=lambda a: a.name)
def test_stored_views(scan, tmp_path, algorithm, monkeypatch):
    """Read some at a time, never all, by one process and by workers; a chunk that is missing is named."""
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


def test_a_slab_that_fails(scan, tmp_path, monkeypatch):
    """One line says which; nothing is written; the same call goes on."""
    from lingo_mi.reconstruction import slab_cluster

    how, out, work = OSSART(niter=2, blocksize=4), tmp_path / 'a.ome.zarr', tmp_path / 'a.ome.zarr.slabs'
    monkeypatch.setattr(slab_cluster, 'write_chunks', lambda *_: (_ for _ in ()).throw(OSError('no room')))
    with pytest.raises(InputError, match='slab 0: no room'):
        run_in_slabs(scan, how, out, 64, runner=InProcess())
    assert [p.name for p in tmp_path.iterdir()] == [work.name] and not (work / 'exchange').exists()
    monkeypatch.undo()
    run_in_slabs(scan, how, out, 64, lambda *_: pytest.fail('computed again'), InProcess())
    assert out.is_dir() and not work.exists()


@pytest.mark.thorough
def test_a_worker_is_killed(scan, tmp_path):
    """On real workers, one of which dies in the middle; then a fit's volume, by an open client."""
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
    refused('needs the whole volume', lm.CGLS(niter=1), cluster='local:2', out=out)
    refused('write local:N', cluster='local:0', out=out)
    refused('no scheduler answers', cluster='tcp://127.0.0.1:1', out=out)
    refused('there is no such file of a scheduler', cluster=str(tmp_path / 'none.json'), out=out)
    refused('cluster must be an address', cluster=3, out=out)
