"""The recipes by name."""

import pytest

from lingo_mi.errors import InputError
from lingo_mi.fitting.recipes import METHODS, VOLUMETRIC, settings_of


def test_names():
    assert tuple(METHODS) == ('fast', 'lingo', 'r2', '3dgs', 'xgaussian')
    assert VOLUMETRIC == ('fast', 'lingo', 'r2')


def test_settings_by_name_and_value():
    assert settings_of('lingo') == METHODS['lingo']
    assert settings_of('lingo', iterations=7) == METHODS['lingo'].changed(iterations=7)
    with pytest.raises(InputError, match='lingo'):
        settings_of('lingoX')
