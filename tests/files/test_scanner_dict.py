"""Geometries by TIGRE's names: which of them leave the circle."""

import numpy as np
import pytest

from lingo_mi.files.scanner_dict import angle_range, moves

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


def test_two_views_may_leave_the_circle():
    assert moves(dict(DSO=[1000.0, 1001.0]), 2) and moves(dict(offDetector=[[0.0, 1.0], [0.0, 2.0]]), 2)


def test_the_range_of_angles():
    """A turn of n views has n steps, the last of them back to the first view."""
    assert angle_range(np.radians([10.0, 100.0, 190.0, 280.0])) == pytest.approx((10, 360))
    assert angle_range(np.radians([30.0])) == pytest.approx((30, 360))
