"""ASD-POCS in slabs: the volume of the whole, and work that is stopped and goes on."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.slab_scan import slanted_scan
from lingo_mi.common.errors import InputError
from lingo_mi.reconstruction import ASDPOCS
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.slab_volume import discard


@pytest.fixture(scope='module')
def scan():
    return slanted_scan()


def relative(actual, whole):
    return np.linalg.norm(actual - whole) / np.linalg.norm(whole)


@pytest.mark.parametrize('thickness', [3, 16])
def test_slabs_are_the_whole_volume(scan, tmp_path, thickness):
    how, steps = ASDPOCS(niter=2, tviter=4, blocksize=5), []
    slabs = how.slabs(scan, thickness, tmp_path / 'work', progress=lambda *step: steps.append(step))
    actual, whole = np.concatenate(list(slabs), 2), run_algorithm(scan, how).volume
    assert relative(actual, whole) < 1e-5 and np.abs(actual - whole).max() < 1e-5 * whole.max()
    count = how.slab_steps(scan, thickness)
    assert [step[:2] for step in steps] == [(i + 1, count) for i in range(count)]
    assert {path.name for path in (tmp_path / 'work').iterdir()} >= {'even.f32', 'fourth.f32', 'state.json'}
    discard(tmp_path / 'work')
    assert not (tmp_path / 'work').exists()


@pytest.mark.parametrize('maxl2err', [None, 0.0, 1e9])
def test_the_step_shrinks_as_for_the_whole(scan, tmp_path, maxl2err):
    """The descent changes more than the sweep, so that it matters if the data are matched. The gradient of total variation
    jumps where the volume is even: the slabs' rounding grows to 1e-5 to 1e-3, and a step of another length changes more than
    1e-2."""
    how = ASDPOCS(niter=3, tviter=2, blocksize=5, alpha=0.5, alpha_red=0.2, rmax=0.1, maxl2err=maxl2err)
    volume = np.concatenate(list(how.slabs(scan, 6, tmp_path / 'work')), 2)
    other = ASDPOCS(**how.options | dict(maxl2err=0.0 if maxl2err == 1e9 else 1e9))
    volumes = [run_algorithm(scan, a).volume for a in (how, other)]
    assert relative(volume, volumes[0]) < 2e-3
    assert maxl2err is None or relative(*volumes) > 1e-2


class Stop(Exception):
    pass


@pytest.mark.parametrize('last', [2, 7, 14])
def test_work_goes_on_to_the_same_bits(scan, tmp_path, last):
    """It is stopped within a sweep, within a descent, and between passes. A pass has two updates and two steps, of two
    slabs."""
    how = ASDPOCS(niter=3, tviter=2, blocksize=5, alpha=0.1, rmax=0.01, maxl2err=0.0)
    whole = list(how.slabs(scan, 8, tmp_path / 'a'))

    def stop(done, *_):
        if done == last:
            raise Stop

    with pytest.raises(Stop):
        list(how.slabs(scan, 8, tmp_path / 'b', progress=stop))
    steps = []
    slabs = list(how.slabs(scan, 8, tmp_path / 'b', progress=lambda done, *_: steps.append(done)))
    np.testing.assert_array_equal(np.concatenate(slabs, 2), np.concatenate(whole, 2))
    assert steps[0] == (last - 1) // 2 * 2 + 1


def test_an_early_end(scan, tmp_path):
    how = ASDPOCS(niter=4, tviter=1, blocksize=9, lmbda=0.008, lmbda_red=0.5, maxl2err=0.0)
    volume = np.concatenate(list(how.slabs(scan, 8, tmp_path)), 2)
    assert json.loads((tmp_path / 'state.json').read_text())['updates'] == 2
    assert relative(volume, run_algorithm(scan, how).volume) < 1e-5
    again = how.slabs(scan, 8, tmp_path, progress=lambda *_: pytest.fail('computed again'))
    np.testing.assert_array_equal(np.concatenate(list(again), 2), volume)


def test_bad_input(scan, tmp_path, monkeypatch):
    with pytest.raises(InputError, match='leave out exact_every'):
        ASDPOCS(exact_every=1).slabs(scan, 8, tmp_path)
    (tmp_path / 'third.f32').write_text('mine')
    with pytest.raises(InputError, match='files named .*third.f32.* that are not ours'):
        next(ASDPOCS().slabs(scan, 8, tmp_path))
    monkeypatch.setattr('shutil.disk_usage', lambda _: SimpleNamespace(free=1000))
    with pytest.raises(InputError, match='four volumes need .* more of the disk'):
        next(ASDPOCS().slabs(scan, 8, tmp_path / 'work'))
