"""The scenes that come with the package, found by name."""

from pathlib import Path

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.scene.shipped import scene_path, scenes

FOLDER = Path(__file__).parents[2] / 'scenes'


def test_every_scene_has_its_name():
    files = {path.relative_to(FOLDER).with_suffix('').as_posix(): path for path in FOLDER.rglob('*.xml')}
    assert scenes().keys() == files.keys() and {'x3d_foot', 'effects/psf'} <= files.keys()
    for name, path in files.items():
        assert scene_path(name).samefile(path)


def test_a_file_comes_before_a_name_and_a_name_before_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mine = Path('mine.xml')
    mine.touch()
    assert scene_path('mine.xml') == scene_path(mine) == mine
    Path('x3d_foot').mkdir()
    assert scene_path('x3d_foot') == scenes()['x3d_foot']
    Path('x3d_foot').rmdir()
    Path('x3d_foot').touch()
    assert scene_path('x3d_foot') == Path('x3d_foot')
    assert scene_path(tmp_path) == tmp_path


@pytest.mark.parametrize('name', ['none.xml', 'foot', 'x3d_foot.xml', 'meshes/flange', 'a' * 300])
def test_what_there_is_not(name):
    with pytest.raises(InputError, match='there is no such scene.*; name a file, or one of .*x3d_foot') as error:
        scene_path(name)
    assert str(error.value).startswith(f'{name[:100]}: ') and '\n' not in str(error.value)


@pytest.mark.parametrize('name', ['x3d_fot', 'x3d_foot.xml', 'foot'])
def test_the_nearest_scene_is_named(name):
    with pytest.raises(InputError, match='did you mean x3d_foot?'):
        scene_path(name)
