"""Kernels of the shipped scenes: they launch the projectors' kernels alone, since no scene names an effect."""

from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from helpers.effects import direct, kernels
from lingo_mi.cli.common import SCANNER
from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import find_effects
from lingo_mi.projectors.objects import find_objects
from lingo_mi.scene.load import defaults, load_scene

SCENES = sorted((Path(__file__).parents[2] / 'scenes').glob('*.xml'))
SMALL = dict(pixels='64', pixel_size='8', size='32')


@pytest.mark.parametrize('path', SCENES, ids=lambda path: path.stem)
def test_shipped_scenes_launch_the_projectors_alone(path):
    """`mi.render` of a view launches what a direct call of the projectors does, in its order."""
    parameters = defaults(path)
    try:
        loaded = load_scene(path, {k: v for k, v in SMALL.items() if k in parameters})
    except InputError as error:
        if 'LINGO_MI_DATA' not in str(error):
            raise
        pytest.skip('LINGO_MI_DATA names no folder with the volume of this scene')
    assert find_effects(loaded.scene, loaded.scanner) is None
    if loaded.scanner.dataset is not None or path.stem == SCANNER:  # measured: nothing is rendered
        with pytest.raises(InputError, match='nothing that attenuates'):
            find_objects(loaded.scene)
        return
    expected = kernels(partial(direct, loaded.scene, extent=5.0))
    assert expected and kernels(lambda: dr.eval(mi.render(loaded.scene))) == expected
