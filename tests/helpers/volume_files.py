"""A small volume whose axes cannot be confused, and files of it that are refused."""

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.volumes import read_volume

SHAPE, SPACING = (4, 5, 6), (0.5, 1.0, 2.5)
COUNTS = np.arange(120, dtype=np.uint8).reshape(SHAPE)
HU = COUNTS.astype(np.int16) * 25 - 1000


def refused(path, match, **options):
    with pytest.raises(InputError, match=match) as caught:
        read_volume(path, **options)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def needs(module):
    return pytest.importorskip(module, reason=f'{module} (the `formats` extra) is not installed')


def read_array(tmp_path, array, **options):
    np.save(tmp_path / 'v.npy', array)
    return read_volume(tmp_path / 'v.npy', **options)
