"""The order in which a fit sees the views."""

import numpy as np
import pytest

from lingo_mi.fitting.view_order import ORDERS, view_order
from lingo_mi.geometry import Geometry


def circle(angles):
    return Geometry.cone(DSO=100, DSD=150, nDetector=4, dDetector=1, nVoxel=4, dVoxel=1, angles=angles)


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('n', [1, 2, 3, 4, 6, 12, 25, 50, 101])
def test_every_view_once(order, n):
    rng = np.random.default_rng(0)
    geometry = circle(np.linspace(0, np.pi, n, endpoint=False))
    first, second = view_order(geometry, order, rng), view_order(geometry, order, rng)
    assert sorted(first) == sorted(second) == list(range(n))
    assert n < 6 or first != second


@pytest.mark.parametrize('turn', [np.pi, 2 * np.pi])
@pytest.mark.parametrize('n', [25, 50, 64])
def test_golden_views_in_a_row_lie_apart(turn, n):
    """By Steinhaus' three gaps, a few multiples of the golden section divide the circle nearly evenly."""
    angles = np.random.default_rng(1).permutation(turn * np.arange(n) / n)  # in any order of the views
    ordered = angles[view_order(circle(angles), 'golden', np.random.default_rng(2))]
    for k in (2, 3, 5, 8):
        rows = np.sort(np.lib.stride_tricks.sliding_window_view(ordered, k), 1)
        assert np.diff(rows).min() >= 0.35 * turn / k


def test_golden_goes_on_from_a_random_view():
    firsts = {view_order(circle(np.arange(25) / 25), 'golden', np.random.default_rng(seed))[0] for seed in range(20)}
    assert len(firsts) > 8
