"""What may be read: regular files, and of those that a file names those beside or below it."""

import os
import threading
from pathlib import Path

import pytest

from lingo_mi.errors import InputError
from lingo_mi.file_access import beside, reading
from lingo_mi.files.ply import read_ply
from lingo_mi.files.scans import read_scan
from lingo_mi.files.volumes import read_volume


@pytest.mark.parametrize('name', ['v.raw', 'v', 'below/v.raw', './v.raw', 'a..b'])
def test_beside(name):
    assert beside(Path('folder/scan.yml'), name) == Path('folder') / name


@pytest.mark.parametrize('name', ['/etc/hostname', '../v', 'a/../../v', '', None, 3, ['v'], '..'])
def test_not_beside(name):
    with pytest.raises(InputError, match='beside it or in a folder below'):
        beside('folder/scan.yml', name)


NAMES = ('v.npy', 'v.npz', 'v.nii', 'v.nii.gz', 'v.hdr', 'v.mha', 'v.nrrd', 'v.tif', 'v.raw', 's.pickle', 'c.ply')


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
