"""Densification: mass, moments, bounds, and that it changes nothing but what it returns."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lingo_mi.fitting.densify import SHRINK, clone, densify, halve, prune, split
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.models.integral import PARAMETERS
from lingo_mi.fitting.state import State, activate, start
from lingo_mi.validation.oracle import whiten

METHOD = R2().changed(densify_threshold=1.0, split_size=0.1)
CONTROL, FORWARD = METHOD.densify, METHOD.forward
HALF = np.ones(3)


def state_of(rng, n, size=None):
    """n Gaussians with moments and a statistic, all different."""
    state = start(rng.uniform(-0.9, 0.9, (n, 3)), np.full(n, 0.05), rng.uniform(0.1, 2, n), FORWARD)
    size = rng.uniform(0.02, 0.4, (n, 3)) if size is None else np.broadcast_to(size, (n, 3))
    share = (size - FORWARD.bounds.scale_min) / (FORWARD.bounds.scale_max - FORWARD.bounds.scale_min)
    values = dict(
        state.values, scale=np.float32(np.log(share / (1 - share))), rotation=np.float32(rng.normal(size=(n, 4)))
    )

    def moments():
        return {k: np.float32(rng.normal(size=(n, m))) for k, m in PARAMETERS.items()}

    return State(
        values,
        moments(),
        moments(),
        np.float32(rng.uniform(0, 4, n)),
        np.float32(rng.integers(0, 3, n)),
        rng.random(n) < 0.3,
    )


def mass(state):
    _, scale, _, density = activate(state, FORWARD)
    return density * scale.prod(1) * (2 * np.pi) ** 1.5


def arrays(state):
    yield from ((f'{g}.{k}', v) for g in ('values', 'first', 'second') for k, v in getattr(state, g).items())
    yield from ((name, getattr(state, name)) for name in ('gradient', 'visits', 'born'))


def assert_same(a, b):
    for (name, x), (_, y) in zip(arrays(a), arrays(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=name)


def assert_consistent(state):
    assert all(len(x) == len(state) for _, x in arrays(state))
    for group in (state.values, state.first, state.second):
        assert all(v.dtype == np.float32 and np.isfinite(v).all() for v in group.values())


def test_clone_keeps_the_mass():
    state = state_of(np.random.default_rng(0), 40)
    chosen = np.arange(40) % 3 == 0
    after = clone(state, chosen, FORWARD)
    n = chosen.sum()
    assert len(after) == 40 + n
    assert_consistent(after)
    assert abs(mass(after).sum() / mass(state).sum() - 1) < 1e-6
    np.testing.assert_allclose(mass(after)[:40][chosen] + mass(after)[40:], mass(state)[chosen], rtol=2e-6)
    np.testing.assert_array_equal(after.values['centre'][40:], state.values['centre'][chosen])
    np.testing.assert_array_equal(after.values['density'][:40][~chosen], state.values['density'][~chosen])


@pytest.mark.parametrize('divide', [split, halve])
def test_a_disc_as_large_as_allowed_is_divided(divide):
    """Its third axis is not shrunk, but leaves its bound."""
    state = state_of(np.random.default_rng(3), 4)
    state.values['scale'][:, 2] = 1e3
    random = [np.random.default_rng(5)] if divide is split else []
    after = divide(state, np.ones(4, bool), FORWARD, *random, flat=True)
    assert np.isfinite(after.values['scale']).all()
    assert activate(after, FORWARD)[1][:, 2] == pytest.approx(0.99 * FORWARD.bounds.scale_max, rel=1e-5)


@pytest.mark.parametrize('divide', [split, halve])
def test_bounds_of_scales_that_hardly_differ(divide):
    forward = METHOD.changed(scale_min=1e-3, scale_max=1.005e-3).forward
    state = start(np.zeros((3, 3), np.float32), np.array([1e-4, 1e-3, 1]), np.ones(3), forward)
    random = [np.random.default_rng(5)] if divide is split else []
    for each in (state, divide(state, np.ones(3, bool), forward, *random)):
        scale = activate(each, forward)[1]
        assert ((scale >= 1e-3) & (scale <= 1.005e-3)).all()


def test_mass_of_a_split():
    """R2's rule gives both halves half the density, and so 1 / 1.6^3 of the mass: a quarter in all."""
    state = state_of(np.random.default_rng(1), 30)
    chosen = np.arange(30) < 20
    after = split(state, chosen, FORWARD, np.random.default_rng(5))
    assert len(after) == 10 + 40
    assert_consistent(after)
    children = mass(after)[10:].reshape(20, 2)
    expected = mass(state)[chosen] * SHRINK**-3
    assert abs(children.sum() / expected.sum() - 1) < 1e-6
    np.testing.assert_allclose(children.sum(1), expected, rtol=5e-6)
    parents = activate(state, FORWARD)[1][chosen].repeat(2, 0)
    np.testing.assert_allclose(activate(after, FORWARD)[1][10:], parents / SHRINK, rtol=5e-6)


@pytest.mark.parametrize('flat', [False, True])
def test_halves_keep_mass_mean_and_covariance(flat):
    state = state_of(np.random.default_rng(1), 30)
    if flat:
        state.values['rotation'][:, :2] = 0
    chosen = np.arange(30) < 20
    after = halve(state, chosen, FORWARD, flat)
    assert len(after) == 10 + 40
    assert_consistent(after)
    children = mass(after)[10:].reshape(20, 2)
    np.testing.assert_allclose(children, mass(state)[chosen].repeat(2).reshape(20, 2) / 2, rtol=5e-6)
    centre, wanted = activate(state, FORWARD)[0][chosen], covariance(state)[chosen]
    halves = activate(after, FORWARD)[0][10:].reshape(20, 2, 3)
    np.testing.assert_allclose(halves.mean(1), centre, atol=1e-6)
    half = (halves[:, 0] - halves[:, 1]) / 2
    assert not flat or not half[:, 2].any()
    actual = covariance(after)[10::2] + half[:, :, None] * half[:, None]
    np.testing.assert_allclose(actual, wanted, atol=1e-6)
    for group in ('first', 'second'):
        for k in PARAMETERS:
            np.testing.assert_array_equal(getattr(after, group)[k][10:], getattr(state, group)[k][chosen].repeat(2, 0))
    assert after.born[10:].all()


def covariance(state):
    _, scale, q, _ = activate(state, FORWARD)
    R = Rotation.from_quat(q).as_matrix()
    return R * scale[:, None] ** 2 @ R.transpose(0, 2, 1)


def test_children_are_drawn_from_their_parent():
    """Whitened by the parent, the offsets of many halves have mean zero and unit covariance."""
    n = 4000
    rng = np.random.default_rng(2)
    state = state_of(rng, 1, size=[0.2, 0.05, 0.01])
    many = State(
        *({k: v.repeat(n, 0) for k, v in g.items()} for g in (state.values, state.first, state.second)),
        *(x.repeat(n) for x in (state.gradient, state.visits, state.born)),
    )
    after = split(many, np.ones(n, bool), FORWARD, rng)
    centre, scale, rotation, _ = (x[0] for x in activate(state, FORWARD))
    offset = whiten(scale, rotation, activate(after, FORWARD)[0] - centre)
    assert np.abs(offset.mean(0)).max() < 5 / np.sqrt(2 * n)
    np.testing.assert_allclose(np.cov(offset.T), np.eye(3), atol=0.08)


@pytest.mark.parametrize('operation', ['clone', 'split'])
def test_moments_travel_and_the_newborn_have_none(operation):
    state = state_of(np.random.default_rng(3), 12)
    chosen = np.arange(12) % 2 == 0
    if operation == 'clone':
        after, old = clone(state, chosen, FORWARD), np.ones(12, bool)
    else:
        after, old = split(state, chosen, FORWARD, np.random.default_rng(0)), ~chosen
    n = old.sum()
    for group in ('first', 'second'):
        for k in PARAMETERS:
            np.testing.assert_array_equal(getattr(after, group)[k][:n], getattr(state, group)[k][old])
            assert not getattr(after, group)[k][n:].any()
    np.testing.assert_array_equal(after.born[:n], state.born[old])
    assert after.born[n:].all() and not after.gradient[n:].any() and not after.visits[n:].any()


def test_prune_rules():
    state = state_of(np.random.default_rng(4), 6)
    state.values['centre'][:] = [[0, 0, 0], [1.01, 0, 0], [0, -0.71, 0], [0, 0, 0.51], [0.99, 0.69, -0.49], [0, 0, 0]]
    state.values['density'][5] = -30
    after = prune(state, CONTROL, FORWARD, [1, 0.7, 0.5])
    np.testing.assert_array_equal(after.values['centre'], state.values['centre'][[0, 4]])
    for group in ('first', 'second'):
        for k in PARAMETERS:
            np.testing.assert_array_equal(getattr(after, group)[k], getattr(state, group)[k][[0, 4]])
    np.testing.assert_array_equal(after.born, state.born[[0, 4]])
    assert not after.gradient.any() and not after.visits.any()


def test_prune_may_leave_nothing():
    state = state_of(np.random.default_rng(4), 3)
    state.values['density'][:] = -30
    after = prune(state, CONTROL, FORWARD, HALF)
    assert len(after) == 0
    assert_consistent(after)


def test_densify_clones_the_small_and_splits_the_large():
    state = state_of(np.random.default_rng(5), 5, size=np.array([0.05, 0.2, 0.05, 0.2, 0.05])[:, None])
    state.values['centre'][:] *= 0.01
    state.values['scale'][1, 1:] = state.values['scale'][0, 1:]  # one long axis is enough to be large
    state.gradient[:] = [3, 3, 0.9, 0.9, 30]
    state.visits[:] = [2, 2, 1, 1, 0]  # the last was never seen: its mean gradient is unknown
    after = densify(state, CONTROL, FORWARD, HALF, np.random.default_rng(0))
    assert_consistent(after)
    assert len(after) == 5 + 2
    assert after.born.sum() - state.born[[0, 2, 3, 4]].sum() == 3  # one copy, two halves
    assert not after.gradient.any() and not after.visits.any()
    density = activate(state, FORWARD)[3]
    expected = [*[density[0] / 2] * 2, *[density[1] / 2] * 2, *density[2:]]
    np.testing.assert_allclose(np.sort(activate(after, FORWARD)[3]), np.sort(expected), rtol=2e-6)


def test_the_mean_gradient_decides():
    """A Gaussian is chosen at the threshold and not just below it, however often it was seen."""
    state = state_of(np.random.default_rng(6), 4, size=0.05)
    state.gradient[:], state.visits[:] = [1, 0.999, 10, 9.99], [1, 1, 10, 10]
    assert len(densify(state, CONTROL, FORWARD, HALF, np.random.default_rng(0))) == 6


def test_no_growth_beyond_the_maximum():
    state = state_of(np.random.default_rng(7), 10, size=0.05)
    state.gradient[:], state.visits[:] = 5, 1
    assert len(densify(state, replace(CONTROL, max_gaussians=20), FORWARD, HALF, np.random.default_rng(0))) == 20
    state.gradient[:] = np.arange(10, 20)
    after = densify(state, replace(CONTROL, max_gaussians=13), FORWARD, HALF, np.random.default_rng(0))
    assert len(after) == 13 and not after.gradient.any()
    np.testing.assert_array_equal(after.values['centre'][10:], state.values['centre'][7:])  # the three strongest
    full = densify(state, replace(CONTROL, max_gaussians=5), FORWARD, HALF, np.random.default_rng(0))
    np.testing.assert_array_equal(full.values['centre'], state.values['centre'])


@pytest.mark.parametrize(
    'operation',
    [
        lambda s, c: clone(s, c, FORWARD),
        lambda s, c: split(s, c, FORWARD, np.random.default_rng(0)),
        lambda s, c: halve(s, c, FORWARD),
        lambda s, c: prune(s, CONTROL, FORWARD, HALF),
        lambda s, c: densify(s, CONTROL, FORWARD, HALF, np.random.default_rng(0)),
    ],
)
def test_inputs_stay_as_they_are(operation):
    state, chosen = state_of(np.random.default_rng(8), 20), np.arange(20) < 9
    before, chosen_before = copy.deepcopy(state), chosen.copy()
    after = operation(state, chosen)
    for _, x in arrays(after):  # nor do they share memory that a later change could reach
        if x.flags.writeable and x.size:
            x[:] = 0
    assert_same(state, before)
    np.testing.assert_array_equal(chosen, chosen_before)


def test_the_generator_decides_alone():
    state = state_of(np.random.default_rng(9), 30)
    one, two, other = (densify(state, CONTROL, FORWARD, HALF, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert_same(one, two)
    assert not np.array_equal(one.values['centre'], other.values['centre'])


def test_coincident_gaussians_stay_distinct():
    state = state_of(np.random.default_rng(10), 8, size=0.2)
    for group in (state.values, state.first, state.second):
        for v in group.values():
            v[:] = v[0]
    state.gradient[:], state.visits[:] = 5, 1
    state.values['centre'][:] = 0
    after = densify(state, CONTROL, FORWARD, HALF, np.random.default_rng(0))
    assert len(after) == 16 and len(np.unique(after.values['centre'], axis=0)) == 16
    assert abs(mass(after).sum() / mass(state).sum() / SHRINK**-3 - 1) < 2e-6


def test_nothing_chosen_changes_nothing():
    state = state_of(np.random.default_rng(11), 9)
    none = np.zeros(9, bool)
    assert_same(clone(state, none, FORWARD), state)
    assert_same(split(state, none, FORWARD, np.random.default_rng(0)), state)
    state.gradient[:] = 0
    after = densify(state, CONTROL, FORWARD, HALF, np.random.default_rng(0))
    for k in PARAMETERS:
        np.testing.assert_array_equal(after.values[k], state.values[k])
