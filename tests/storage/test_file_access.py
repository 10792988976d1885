"""Files that may be read: regular files, and files named in them if they are beside or below them."""

import os
import threading
from pathlib import Path
from unittest import mock

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.ply import read_ply
from lingo_mi.files.scans import read_scan
from lingo_mi.files.volumes import read_volume
from lingo_mi.storage.file_access import beside, read_object, reading, replacing, require_writable, write_text
from lingo_mi.storage.output_folder import manifest_of


@pytest.mark.parametrize('name', ['v.raw', 'v', 'below/v.raw', './v.raw', 'a..b'])
def test_beside(name):
    assert beside(Path('folder/scan.yml'), name) == Path('folder') / name


@pytest.mark.parametrize('name', ['/etc/hostname', '../v', 'a/../../v', '', None, 3, ['v'], '..'])
def test_not_beside(name):
    with pytest.raises(InputError, match='beside it or in a folder below'):
        beside('folder/scan.yml', name)


NAMES = ('v.npy', 'v.npz', 'v.nii', 'v.nii.gz', 'v.hdr', 'v.mha', 'v.nrrd', 'v.tif', 'v.raw', 's.pickle', 'c.ply')


@pytest.mark.posix
@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize('kind', ['pipe', 'device', 'folder'])
def test_no_reader_waits_for_a_pipe_or_reads_a_device(tmp_path, name, kind):
    path = tmp_path / name
    if kind == 'pipe':
        os.mkfifo(path)
    elif kind == 'device':
        path.symlink_to('/dev/zero')
    elif kind == 'folder':
        path.mkdir()
    read = {'.pickle': read_scan, '.ply': read_ply}.get(path.suffix, read_volume)
    caught = []

    def call():
        try:
            read(path)
        except InputError as error:
            caught.append(str(error))

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(20)
    assert caught and ('cannot be read' in caught[0] or kind == 'folder'), 'it waits'


@pytest.mark.parametrize('path', ['a\0b', 'a\udcff\ud800'])
def test_names_that_are_none(path):
    with pytest.raises(InputError), reading(path):
        pass


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('old')
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        assert temporary.parent == tmp_path and temporary.name.endswith('a.txt') and temporary.stat().st_size == 0
        temporary.write_text('new')
        raise RuntimeError
    assert path.read_text() == 'old' and os.listdir(tmp_path) == ['a.txt']
    write_text(path, 'new \udcff')
    assert path.read_text() == 'new \\udcff' and os.listdir(tmp_path) == ['a.txt']


def test_the_content_is_on_the_disk_before_the_name(tmp_path, monkeypatch):
    done = []
    for name in ('fsync', 'replace'):
        call = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, call=call, name=name: done.append(name) or call(*a))
    write_text(tmp_path / 'a', 'x')
    assert done == ['fsync', 'replace', 'fsync']


def test_links_are_not_followed_for_writing(tmp_path):
    (tmp_path / 'other').write_text('mine')
    (tmp_path / 'a').symlink_to(tmp_path / 'other')
    write_text(tmp_path / 'a', 'new')
    assert (tmp_path / 'other').read_text() == 'mine' and (tmp_path / 'a').read_text() == 'new'


@pytest.mark.posix
def test_names_of_any_length_and_bytes(tmp_path):
    for name in ('a' * 251 + '.txt', 'ä' * 127, os.fsdecode(b'\xff' * 200)):
        write_text(tmp_path / name, 'x')
        assert (tmp_path / name).read_text() == 'x'


def test_the_probe_has_a_name_of_its_own(tmp_path):
    (tmp_path / '.writable').write_text('mine')
    require_writable(tmp_path, tmp_path)
    assert (tmp_path / '.writable').read_text() == 'mine' and os.listdir(tmp_path) == ['.writable']


def test_the_probe_makes_nothing(tmp_path):
    """It does not even make folders that it would remove again, because two commands may begin at once."""
    made = []
    with mock.patch.object(Path, 'mkdir', lambda *a, **k: made.append(a)):
        require_writable(tmp_path / 'a' / 'b', tmp_path)
    assert not made and os.listdir(tmp_path) == []
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match='cannot write there'):
        require_writable(tmp_path / 'file' / 'b', tmp_path)


@pytest.mark.parametrize('call', [lambda f: read_object(f / 'metrics.json'), manifest_of])
def test_json_that_is_nested_too_deeply(tmp_path, call):
    for name in ('.lingo_mi.json', 'metrics.json'):
        (tmp_path / name).write_text('[' * 200_000)
    with pytest.raises(InputError):
        call(tmp_path)
