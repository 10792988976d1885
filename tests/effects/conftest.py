"""Scenes with effects, as files."""

import pytest

from helpers.effects import XML


@pytest.fixture
def scene_file(tmp_path):
    """Writes a scene, the usual one or another text, and returns its path."""

    def written(text=XML):
        (tmp_path / 'scene.xml').write_text(text)
        return tmp_path / 'scene.xml'

    return written
