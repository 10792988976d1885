"""The scan of the tiny scene, and a fit to half of its views."""

import pytest

from helpers.script import fit
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import take_scan


@pytest.fixture(scope='module')
def dataset(scene):
    """The scan of the scene."""
    return take_scan(load_scene(scene))


@pytest.fixture(scope='module')
def fitted(scene):
    """result.xml of a short fit to four of the eight views."""
    folder = scene.parent / 'fitted'
    code, _, err = fit(scene, '--views', '4', '--iterations', '40', '--out', folder, '-D', 'n_points=300')
    assert code == 0, err
    return folder / 'result.xml'
