"""Files in a folder that are ours, and whether they belong together."""

import json

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.storage.folder_lock import LOCK
from lingo_mi.storage.output_folder import (
    CHECKPOINT,
    MANIFEST,
    METRICS,
    SCENE,
    begin,
    clear_leftovers,
    complete_result,
    manifest_of,
    occupants,
    remove_others,
    require_together,
)


def make(folder, text='old'):
    """A whole result of two files."""
    begin(folder, [SCENE, METRICS])
    (folder / SCENE).write_text(text)
    return complete_result(folder, [SCENE], dict(psnr=1))


def test_a_whole_result(tmp_path):
    assert json.loads((tmp_path / METRICS).read_text() if make(tmp_path) else '') == make(tmp_path)
    require_together(tmp_path, [SCENE])
    assert manifest_of(tmp_path).files == {SCENE, METRICS} and not manifest_of(tmp_path).writing


def test_the_mark_goes_first(tmp_path):
    make(tmp_path)
    begin(tmp_path, [CHECKPOINT])
    assert not (tmp_path / METRICS).exists() and (tmp_path / SCENE).read_text() == 'old'
    with pytest.raises(InputError, match='not completed'):
        require_together(tmp_path, [SCENE])
    require_together(tmp_path, ['copied.xml'])


def test_a_changed_part_is_refused(tmp_path):
    make(tmp_path)
    (tmp_path / SCENE).write_text('new')
    with pytest.raises(InputError, match='does not match'):
        require_together(tmp_path, [SCENE])
    (tmp_path / METRICS).unlink()  # a user's own doing: no write was under way
    require_together(tmp_path, [SCENE])


@pytest.mark.parametrize('name', [SCENE, METRICS, 'views/0000.exr'])
def test_foreign_files_are_refused(tmp_path, name):
    (tmp_path / 'views').mkdir()
    (tmp_path / name).write_text('mine')
    with pytest.raises(InputError, match='was not written by lingo_mi'):
        begin(tmp_path, [name])
    assert (tmp_path / name).read_text() == 'mine' and not (tmp_path / MANIFEST).exists()


@pytest.mark.parametrize('name', [SCENE, METRICS, 'views', MANIFEST])
def test_links_are_refused_even_where_the_name_is_ours(tmp_path, name):
    folder, other = tmp_path / 'a', tmp_path / 'other'
    folder.mkdir()
    make(folder)
    other.mkdir() if name == 'views' else other.write_text('mine')
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(other)
    with pytest.raises(InputError, match='is a link'):
        begin(folder, [SCENE])
    assert (folder / name).is_symlink() and (name == 'views' or other.read_text() == 'mine')


def test_others_are_removed_only_if_ours(tmp_path):
    (tmp_path / 'views').mkdir()
    begin(tmp_path, ['views/0000.exr', 'views/0001.exr', METRICS])
    for name in ('0000.exr', '0001.exr', '0002.exr', 'mine.exr'):
        (tmp_path / 'views' / name).touch()
    remove_others(tmp_path, ['views/0000.exr'])
    assert sorted(p.name for p in (tmp_path / 'views').iterdir()) == ['0000.exr', '0002.exr', 'mine.exr']


@pytest.mark.parametrize('text', ['', '[]', '{"files": 3, "writing": true}', '{"files": [], "writing": 1}', '\xff{'])
def test_a_manifest_that_is_none(tmp_path, text):
    (tmp_path / MANIFEST).write_text(text, encoding='latin1')
    with pytest.raises(InputError, match='not a manifest'):
        begin(tmp_path, [SCENE])
    assert (tmp_path / MANIFEST).read_text(encoding='latin1') == text


def test_a_manifest_cannot_name_files_elsewhere(tmp_path):
    folder = tmp_path / 'a'
    (folder / 'views').mkdir(parents=True)
    victims = [tmp_path / 'x.exr', folder / 'mine', folder / 'views' / 'mine.exr']
    for path in victims:
        path.touch()
    names = ['../x.exr', str(victims[0]), 'mine', 'views/mine.exr', 'views/../../x.exr', 'views/0000.exr\n']
    (folder / MANIFEST).write_text(json.dumps(dict(files=names, writing=False)))
    remove_others(folder, [])
    assert all(path.exists() for path in victims)


def test_leftovers(tmp_path):
    """Temporaries of ours do not fill a folder, and go; what merely looks like one stays."""
    ours = [f'.lingo_mi-{16 * "a"}-{name}' for name in (METRICS, CHECKPOINT, MANIFEST)]
    other = [f'.lingo_mi-{16 * "a"}-notes.txt', '.writable', 'metrics.json.partial', '.lingo_mi-1-metrics.json']
    for name in (*ours, *other, LOCK):
        (tmp_path / name).touch()
    assert occupants(tmp_path) == sorted(other)
    clear_leftovers(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*other, LOCK])
