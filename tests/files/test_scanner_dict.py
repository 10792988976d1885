"""Geometries by TIGRE's names: which of them leave the circle."""

import numpy as np
import pytest

from lingo_mi.files.scanner_dict import moves

N = 3


@pytest.mark.parametrize(
    'values, expected',
    [
        (dict(DSO=1000.0, offDetector=[0, 0], offOrigin=[0, 0, 0]), False),
        (dict(offDetector=None), False),
        (dict(DSO=np.full(N, 1000.0)), True),
        (dict(DSD=[1500.0]), False),
        (dict(offDetector=np.zeros((N, 2))), True),
        (dict(offOrigin=np.zeros((N, 3))), True),
    ],
)
def test_a_number_for_every_view_leaves_the_circle(values, expected):
    assert moves(values, N) is expected
