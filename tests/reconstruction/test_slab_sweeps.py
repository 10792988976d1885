"""SART, OS-SART and SIRT in slabs: the volume of the whole, in the memory of a slab, and work that is stopped and goes on."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lingo_mi as lm
from helpers.script import FIT, SCENE, run
from helpers.slab_scan import slanted_scan
from lingo_mi.common.errors import InputError
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import Grid, PosedGeometry
from lingo_mi.geometry.rays import Rays
from lingo_mi.reconstruction import OSSART, SART, SIRT
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.slab_sweeps import SweepPlan
from lingo_mi.reconstruction.slab_volume import discard

RECONSTRUCT = FIT.with_name('reconstruct.py')
ALGORITHMS = SART(niter=3), OSSART(niter=3, blocksize=4, noneg=False), SIRT(niter=3)


@pytest.fixture(scope='module')
def scan():
    return slanted_scan()


def difference(actual, whole):
    return np.abs(np.concatenate(list(actual), 2) - whole).max() / np.abs(whole).max()


@pytest.mark.parametrize(
    'algorithm, thickness',
    [
        *((algorithm, 5) for algorithm in ALGORITHMS),
        (SIRT(niter=3), 1),
        *(
            pytest.param(algorithm, thickness, marks=pytest.mark.thorough)
            for algorithm in ALGORITHMS
            for thickness in (1, 8, 24)
            if (algorithm.name, thickness) != ('sirt', 1)
        ),
    ],
    ids=lambda value: getattr(value, 'name', value),
)
def test_slabs_are_the_whole_volume(scan, tmp_path, algorithm, thickness):
    steps = []
    slabs = algorithm.slabs(scan, thickness, tmp_path / 'work', progress=lambda *step: steps.append(step))
    assert difference(slabs, run_algorithm(scan, algorithm).volume) < 1e-5
    count = algorithm.slab_steps(scan, thickness)
    assert [step[:2] for step in steps] == [(i + 1, count) for i in range(count)]
    assert steps[0][2] == 1 and steps[-1][2] < 0.1  # of an empty volume, and of the last
    discard(tmp_path / 'work')
    assert not (tmp_path / 'work').exists()


def test_invalid_pixels(scan, tmp_path):
    """Slabs are the whole volume in a scan with invalid pixels, too."""
    valid = np.ones(scan.projections.shape, bool)
    valid[:, 10:20, 20:30] = False
    holed = replace(scan, valid=valid)
    assert (
        difference(SART(niter=2).slabs(holed, 5, tmp_path / 'work'), run_algorithm(holed, SART(niter=2)).volume) < 1e-5
    )


class Stop(Exception):
    pass


@pytest.mark.parametrize('last', [1, 2, 3, 10, 12])
def test_work_goes_on_to_the_same_bits(scan, tmp_path, last):
    """It is stopped within the first update, between two, and within the last."""
    how = OSSART(niter=2, blocksize=5)
    whole = list(how.slabs(scan, 6, tmp_path / 'a'))

    def stop(done, *_):
        if done == last:
            raise Stop

    with pytest.raises(Stop):
        list(how.slabs(scan, 6, tmp_path / 'b', progress=stop))
    steps = []
    slabs = list(how.slabs(scan, 6, tmp_path / 'b', progress=lambda done, *_: steps.append(done)))
    np.testing.assert_array_equal(np.concatenate(slabs, 2), np.concatenate(whole, 2))
    assert steps[0] == (last - 1) // 3 * 3 + 1  # three slabs an update


def test_the_volume_stays(scan, tmp_path):
    """If work is stopped after the last update, while slabs are taken or written, nothing is computed again."""
    how, work = SART(niter=1), tmp_path / 'work'
    (tmp_path / 'work').mkdir()
    (work / '.lingo_mi-0123456789abcdef-state.json').touch()  # of a process that was killed while it wrote
    taken = how.slabs(scan, 6, work)
    first = next(taken)
    taken.close()
    for _ in range(2):
        slabs = list(how.slabs(scan, 6, work, progress=lambda *_: pytest.fail('computed again')))
        np.testing.assert_array_equal(slabs[0], first)
    discard(work)
    assert not work.exists()


def test_work_that_was_being_discarded(scan, tmp_path):
    """If work was killed after the volume was written, while its files were removed, the same call begins anew."""
    how, work = SART(niter=2), tmp_path / 'work'
    whole = np.concatenate(list(how.slabs(scan, 6, work)), 2)
    for name in ('even.f32', 'odd.f32'):
        (work / name).unlink()
        np.testing.assert_array_equal(np.concatenate(list(how.slabs(scan, 6, work)), 2), whole)


def test_poses_in_the_middle_count(scan, tmp_path):
    """One pose of 400 that has moved makes another digest."""
    rays = scan.geometry.rays()
    many = Rays(*(np.resize(part, (400, 3)) for part in (rays.source, rays.corner, rays.u, rays.v)), rays.parallel)
    moved = replace(many, source=many.source + 1e-9 * (np.arange(400) == 200)[:, None])
    digests = []
    for poses in (many, moved):
        g = scan.geometry
        geometry = PosedGeometry(poses=poses, nDetector=g.nDetector, grid=g.grid)
        views = lm.Scan(geometry, np.zeros((400, *g.nDetector), np.float32))
        digests.append(SweepPlan([], True).digest(views, 8))
    assert digests[0] != digests[1]


def test_files_of_the_user_stay(scan, tmp_path):
    (tmp_path / 'odd.f32').write_text('mine')
    with pytest.raises(InputError, match='files named even.f32 or odd.f32 that are not ours'):
        next(SART().slabs(scan, 8, tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == ['odd.f32'] and (tmp_path / 'odd.f32').read_text() == 'mine'


def test_other_work_is_left_alone(scan, tmp_path):
    how = SART(niter=2)
    slabs = how.slabs(scan, 16, tmp_path / 'work')
    next(slabs)
    slabs.close()
    before = {p.name: p.read_bytes() for p in (tmp_path / 'work').iterdir()}
    assert set(before) == {'even.f32', 'odd.f32', 'state.json'}
    others = scan.projections.copy()
    others[0, 0, 0] += 1e-3
    for other, options in (
        (scan, SART(niter=3)),
        (scan, SART(niter=2, noneg=False)),
        (replace(scan, projections=others), how),
    ):
        with pytest.raises(InputError, match='holds a reconstruction of other data or with other options'):
            next(options.slabs(other, 16, tmp_path / 'work'))
    with pytest.raises(InputError, match='holds a reconstruction of other data'):
        next(how.slabs(scan, 8, tmp_path / 'work'))
    assert {p.name: p.read_bytes() for p in (tmp_path / 'work').iterdir()} == before


def test_spoiled_files(scan, tmp_path):
    how, work = SART(niter=1), tmp_path / 'work'
    slabs = how.slabs(scan, 16, work)
    next(slabs)
    slabs.close()
    whole = {path.name: path.read_bytes() for path in work.iterdir()}
    for name in ('even.f32', 'odd.f32'):
        (work / name).write_bytes(whole[name][:-4])
    with pytest.raises(InputError, match='is cut off; remove its folder'):
        list(how.slabs(scan, 16, work))
    for text in ('', '{', '[]', '{"of": 1}', 'null', '\xff'):
        (work / 'state.json').write_text(text, encoding='latin-1')
        with pytest.raises(InputError, match='is not a state of ours'):
            list(how.slabs(scan, 16, work))


def test_bad_input(scan, tmp_path, monkeypatch):
    with pytest.raises(InputError, match='leave out tol'):
        SART(tol=0.1).slabs(scan, 8, tmp_path / 'work')
    with pytest.raises(InputError, match='thickness of a slab, in slices, must be a whole number from 1 on, not 0'):
        next(SART().slabs(scan, 0, tmp_path / 'work'))
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 1000)
    with pytest.raises(InputError, match='need at least .* of memory'):
        next(SART().slabs(scan, 8, tmp_path / 'work'))
    monkeypatch.undo()
    fine = lm.Scan(scan.geometry.on(Grid((96, 80, 64), (1.0, 1.25, 1.5), scan.geometry.grid.centre)), scan.projections)
    with pytest.raises(InputError, match='pixels are two or more voxels wide'):
        next(SART().slabs(fine, 8, tmp_path / 'work'))
    with pytest.raises(InputError, match='cannot be written'):
        next(SART().slabs(scan, 8, Path('/proc/no/such')))
    monkeypatch.setattr('shutil.disk_usage', lambda _: SimpleNamespace(free=1000))
    with pytest.raises(InputError, match='two volumes need .* more of the disk'):
        next(SART().slabs(scan, 8, tmp_path / 'work'))
    assert not (tmp_path / 'work').exists()


@pytest.mark.thorough
def test_the_command(tmp_path):
    """Killed by the system, the command goes on when it is given again."""
    scene, out, work = tmp_path / 'tiny.xml', tmp_path / 'slabs.nii.gz', tmp_path / 'slabs.nii.gz.slabs'
    scene.write_text(SCENE)
    options = '--algorithm', 'sart', '-D', 'niter=15'
    code, _, err = run(RECONSTRUCT, scene, *options, '--out', tmp_path / 'whole.nii.gz')
    assert code == 0, err
    command = [sys.executable, RECONSTRUCT, scene, *options, '--slab', '8', '--out', out]
    process = subprocess.Popen([str(word) for word in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    state = work / 'state.json'
    while not state.exists() or json.loads(state.read_text())['updates'] < 2:
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert not out.exists()
    code, text, err = run(RECONSTRUCT, scene, *options, '--slab', 8, '--out', out)
    assert code == 0 and str(out) in text and not work.exists(), err
    whole, actual = read_volume(tmp_path / 'whole.nii.gz').data, read_volume(out).data
    assert np.abs(actual - whole).max() < 1e-5 * whole.max()
    code, _, err = run(RECONSTRUCT, scene, *options, '--slab', 8, '--start', 'x.xml', '--out', out, '--force')
    assert code == 2 and 'leave out --start' in err


PROGRAM = """
import sys
import numpy as np
import lingo_mi as lm
from lingo_mi.reconstruction.slab_sweeps import sweep_memory
from lingo_mi.common.runtime import use_variant
use_variant('llvm_ad_mono')

def go(side, slices, pixels, views, thickness, blocksize):
    g = lm.Geometry.cone(
        DSO=1000, DSD=1500, nDetector=pixels, dDetector=500 / pixels, nVoxel=(side, side, slices), dVoxel=256 / side,
        angles=np.linspace(0, 3, views),
    )
    scan = lm.Scan(g, np.ones((views, pixels, pixels), np.float32))
    for slab in lm.OSSART(niter=1, blocksize=blocksize).slabs(scan, thickness, f'{sys.argv[1]}/{side}_{slices}_{pixels}'):
        pass
    return sweep_memory(scan, thickness, blocksize)

def peak():
    return 1024 * next(int(l.split()[1]) for l in open('/proc/self/status') if l.startswith('VmHWM'))

go(16, 16, 24, 8, 8, 4)
before = peak()
expected = go(*map(int, sys.argv[2:]))
print(peak() - before, expected)
"""


@pytest.mark.thorough
@pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='asks Linux for its peak memory')
@pytest.mark.parametrize(
    'sizes',
    [(256, 512, 192, 4, 16, 1), (64, 64, 512, 40, 16, 1), (64, 64, 512, 40, 16, 20)],
    ids=['slabs', 'projections', 'blocks'],
)
def test_peak_memory(tmp_path, sizes):
    """`needed` predicts it, whatever the number of slices. The first case's volume alone takes 134 MB."""
    for folder in ('first', 'second'):  # the first compiles the kernels, which takes memory of its own
        command = [sys.executable, '-c', PROGRAM, str(tmp_path / folder), *map(str, sizes)]
        taken, expected = map(int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    print(f'{sizes}: {taken / 1e6:.0f} of {expected / 1e6:.0f} MB')
    assert 0.3 * expected < taken < expected + 5e6  # for kernels of these shapes
