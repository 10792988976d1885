"""Counts of items in one element: piles are found, and spread clouds have none."""

import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.projectors.depth import deep, deepest, parts_of

SHAPES = {2: (300, 70), 3: (40, 20, 30)}


def depth_of(places, shape, covered=1.0):
    axes = [mi.Int32(np.asarray(p, np.int32)) for p in places]
    return float(deepest(axes, mi.Float(np.full(len(places[0]), covered, np.float32)), shape)[0])


@pytest.mark.parametrize('shape', SHAPES.values(), ids=SHAPES)
def test_a_pile_in_one_element(shape):
    """A pile is found with others all around it."""
    rng, count = np.random.default_rng(0), 2 * deep()
    around = [rng.integers(0, n, 500) for n in shape]
    pile = [np.full(count, n // 3) for n in shape]
    assert depth_of([np.append(a, b) for a, b in zip(around, pile)], shape) == pytest.approx(count, abs=5)


@pytest.mark.parametrize('shape', SHAPES.values(), ids=SHAPES)
def test_items_in_elements_of_their_own(shape):
    places = np.unravel_index(np.arange(3 * deep()), shape)
    assert depth_of(places, shape) < 0.02 * deep()


@pytest.mark.parametrize('shape', SHAPES.values(), ids=SHAPES)
def test_items_that_cover_everything(shape):
    """They overlap wherever their centres are. As they add different numbers, they count RANDOM times less."""
    rng, count = np.random.default_rng(0), 4 * deep()
    places = [rng.integers(0, n, count) for n in shape]
    depth = depth_of(places, shape, float(np.prod(shape)))
    assert depth == pytest.approx(count / 32, rel=0.02)


def test_large_clouds_are_sampled():
    """Of 100,000 items every tenth is in one place, and the depth is found to a tenth."""
    rng, count = np.random.default_rng(0), 100_000
    at = np.where(np.arange(count) % 10 == 0, 5, rng.integers(0, 70, count)), rng.integers(0, 300, count)
    at[1][::10] = 7
    assert depth_of(at[::-1], (300, 70)) == pytest.approx(count / 10, rel=0.1)


def test_few_items_need_no_count():
    assert depth_of([np.zeros(deep())] * 2, SHAPES[2]) == 0
    assert depth_of([np.zeros(deep() + 1)] * 2, SHAPES[2]) == deep() + 1


def test_items_that_are_not_finite_are_not_counted():
    count = 2 * deep()
    covered = mi.Float(np.where(np.arange(count) == 3, np.nan, 1).astype(np.float32))
    axes = [mi.Int32(np.zeros(count, np.int32))] * 2
    assert float(deepest(axes, covered, SHAPES[2])[0]) == count - 1


def test_parts():
    assert [parts_of(mi.Float(x)) for x in (0, 1, deep(), deep() + 1, 3 * deep())] == [1, 1, 1, 2, 3]
