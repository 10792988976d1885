"""One writer at a time, and no lock outlives its owner."""

import json
import os
import socket
import subprocess
import sys

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.storage import folder_lock
from lingo_mi.storage.folder_lock import LOCK, locked

HOLD = (
    'import sys\nfrom lingo_mi.storage.folder_lock import locked\n'
    'with locked(sys.argv[1]):\n print("held", flush=True)\n sys.stdin.read()'
)


def holder(folder):
    process = subprocess.Popen([sys.executable, '-c', HOLD, str(folder)], stdin=-1, stdout=-1, text=True)
    assert process.stdout.readline() == 'held\n'
    return process


def test_the_second_is_told_who_writes(tmp_path):
    process = holder(tmp_path / 'a')
    try:
        with pytest.raises(InputError, match=f'process {process.pid} on .* is writing there'), locked(tmp_path / 'a'):
            pass
    finally:
        process.kill()
        process.communicate()
    assert (tmp_path / 'a' / LOCK).exists()
    with locked(tmp_path / 'a'):
        assert json.loads((tmp_path / 'a' / LOCK).read_text())['pid'] == os.getpid()


def test_in_one_process(tmp_path):
    (tmp_path / 'mine').touch()
    with locked(tmp_path), pytest.raises(InputError, match=str(os.getpid())), locked(tmp_path):
        pass
    with locked(tmp_path), locked(tmp_path, 'another'):
        pass
    assert os.listdir(tmp_path) == ['mine']


def test_folders_are_removed_again(tmp_path):
    with locked(tmp_path / 'a' / 'b'):
        assert (tmp_path / 'a' / 'b').is_dir()
    assert not (tmp_path / 'a').exists()


@pytest.mark.parametrize('system', [None, pytest.param('refuses', marks=pytest.mark.posix)])
def test_without_locks_of_the_system(tmp_path, monkeypatch, system):
    """The file itself is the lock, and a dead process's lock on this computer is taken over."""

    def flock(*_):
        raise OSError(95, 'not supported')

    if system is None:
        monkeypatch.setattr(folder_lock, 'fcntl', None)
    else:
        monkeypatch.setattr(folder_lock.fcntl, 'flock', flock)
    with locked(tmp_path), pytest.raises(InputError, match=f'remove {LOCK}'), locked(tmp_path):
        pass
    dead = subprocess.Popen([sys.executable, '-c', ''])
    dead.wait()
    (tmp_path / LOCK).write_text(json.dumps(dict(pid=dead.pid, host='elsewhere')))
    with pytest.raises(InputError, match='elsewhere'), locked(tmp_path):
        pass
    (tmp_path / LOCK).write_text(json.dumps(dict(pid=dead.pid, host=socket.gethostname())))
    with locked(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


def test_a_number_that_no_process_has(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_lock, 'fcntl', None)
    (tmp_path / LOCK).write_text(json.dumps(dict(pid=10**30, host=socket.gethostname())))
    with locked(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


def test_what_is_no_lock(tmp_path):
    (tmp_path / LOCK).write_text('my notes')
    with pytest.raises(InputError, match='not a lock'), locked(tmp_path):
        pass
    assert (tmp_path / LOCK).read_text() == 'my notes'
    (tmp_path / LOCK).unlink()
    (tmp_path / 'other').write_text('mine')
    (tmp_path / LOCK).symlink_to(tmp_path / 'other')
    with pytest.raises(InputError, match='not a lock'), locked(tmp_path):
        pass
    assert (tmp_path / 'other').read_text() == 'mine'
