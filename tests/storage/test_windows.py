"""Files where Windows' rules hold: no name is taken from a file that is open."""

import os
import sys

import numpy as np
import pytest

from helpers import windows
from helpers.script import SCENE, run
from lingo_mi.common.errors import InputError
from lingo_mi.files.volumes import read_volume
from lingo_mi.storage import file_access
from lingo_mi.storage.file_access import leftovers, new_folder, write_text
from lingo_mi.storage.folder_lock import LOCK, locked

pytestmark = pytest.mark.skipif(sys.platform != 'linux', reason='asks Linux which files are open')


@pytest.fixture(autouse=True)
def on_windows(monkeypatch):
    waits = []
    windows.install(monkeypatch)
    monkeypatch.setattr(file_access.time, 'sleep', waits.append)
    return waits


def test_a_reader_is_waited_for(tmp_path, monkeypatch):
    write_text(tmp_path / 'a', 'old')
    reader = (tmp_path / 'a').open()
    monkeypatch.setattr(file_access.time, 'sleep', lambda _: reader.close())
    write_text(tmp_path / 'a', 'new')
    assert (tmp_path / 'a').read_text() == 'new' and os.listdir(tmp_path) == ['a']


def test_a_reader_that_stays(tmp_path, on_windows):
    write_text(tmp_path / 'a', 'old')
    with (tmp_path / 'a').open(), pytest.raises(InputError, match=r'a: cannot be written \(Access is denied\)'):
        write_text(tmp_path / 'a', 'new')
    assert (tmp_path / 'a').read_text() == 'old' and os.listdir(tmp_path) == ['a'] and 1 < sum(on_windows) < 5


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / 'a').mkdir()
    with new_folder(tmp_path / 'a') as folder:
        (folder / 'b').write_text('new')
    assert (tmp_path / 'a' / 'b').read_text() == 'new' and os.listdir(tmp_path) == ['a']


def test_the_lock_is_removed(tmp_path):
    with locked(tmp_path), pytest.raises(InputError, match='is writing there'), locked(tmp_path):
        pass
    assert not os.listdir(tmp_path)


@pytest.mark.thorough
def test_a_fit_closes_what_it_replaces(tmp_path):
    scene, out = tmp_path / 'tiny.xml', tmp_path / 'out'
    scene.write_text(SCENE)
    for more in [], ['--force'], ['--resume']:
        code, _, err = run('fit', scene, '--iterations', 4, '--out', out, *more, report='--force' in more)
        assert code == 0, err
    assert (out / 'report.html').exists() and not (out / LOCK).exists() and not leftovers(out)


def test_slabs_are_closed_before_they_are_removed(tmp_path):
    scene, volume = tmp_path / 'tiny.xml', tmp_path / 'slabs.nii.gz'
    scene.write_text(SCENE)
    code, _, err = run('reconstruct', scene, '--algorithm', 'sart', '-D', 'niter=2', '--slab', 12, '--out', volume)
    assert code == 0, err
    assert np.isfinite(read_volume(volume).data).all()
    assert sorted(os.listdir(tmp_path)) == ['slabs.nii.gz', 'tiny.xml']
