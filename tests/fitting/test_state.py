"""Raw parameters and Gaussians: activation at its ends, the device twin, Adam's step."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.fitting.activations import inverse_scale, inverse_softplus, softplus
from lingo_mi.fitting.adam import adam_step
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.models.integral import PARAMETERS
from lingo_mi.fitting.state import State, activate, start

FORWARD = R2().changed(scale_min=1e-3, scale_max=0.8).forward


def random_state(rng, n):
    def columns(size):
        return {k: np.float32(rng.normal(size=(n, m)) * size) for k, m in PARAMETERS.items()}

    second = {k: np.abs(v) for k, v in columns(0.01).items()}
    return State(
        columns(1),
        columns(0.1),
        second,
        np.float32(rng.random(n)),
        np.float32(rng.integers(0, 5, n)),
        rng.random(n) < 0.5,
    )


def test_start_then_activate_gives_the_cloud_back():
    rng = np.random.default_rng(0)
    points, spacing, density = rng.uniform(-1, 1, (50, 3)), np.geomspace(2e-3, 0.7, 50), np.geomspace(1e-5, 50, 50)
    centre, scale, rotation, rho = activate(start(points, spacing, density, FORWARD), FORWARD)
    np.testing.assert_allclose(centre, points, atol=1e-7)
    np.testing.assert_allclose(scale, spacing[:, None].repeat(3, 1), rtol=2e-6)
    np.testing.assert_array_equal(rotation, np.tile([0, 0, 0, 1], (50, 1)))
    np.testing.assert_allclose(rho, density, rtol=2e-6)


def test_start_has_no_history():
    state = start(np.zeros((3, 3)), np.full(3, 0.1), np.ones(3), FORWARD)
    assert len(state) == 3 and not state.born.any() and not state.gradient.any() and not state.visits.any()
    assert all(not v.any() for columns in (state.first, state.second) for v in columns.values())
    assert {k: v.shape for k, v in state.values.items()} == {k: (3, m) for k, m in PARAMETERS.items()}
    assert all(v.dtype == np.float32 for c in (state.values, state.first, state.second) for v in c.values())


def test_scales_beyond_the_bounds_start_inside_them():
    _, scale, _, _ = activate(start(np.zeros((2, 3)), np.array([1e-9, 1e3]), np.ones(2), FORWARD), FORWARD)
    assert np.all((scale > FORWARD.bounds.scale_min) & (scale < FORWARD.bounds.scale_max))


def test_softplus_at_both_ends():
    x = np.array([-80.0, -30, -1, 0, 1, 30, 800])
    np.testing.assert_allclose(
        softplus(x),
        [np.exp(-80), np.exp(-30), np.log1p(np.exp(-1)), np.log(2), 1 + np.log1p(np.exp(-1)), 30, 800],
        rtol=1e-12,
    )
    y = np.geomspace(1e-29, 1e6, 80)
    np.testing.assert_allclose(softplus(inverse_softplus(y)), y, rtol=1e-12)
    assert np.isfinite(inverse_softplus(np.array([0.0, 1e-300]))).all()


def test_scales_stay_between_their_bounds():
    state = random_state(np.random.default_rng(1), 6)
    state.values['scale'][:] = np.float32([-100, -20, -1, 1, 20, 100])[:, None]
    _, scale, _, _ = activate(state, FORWARD)
    assert np.all(np.isfinite(scale)) and np.all(
        (scale >= FORWARD.bounds.scale_min) & (scale <= FORWARD.bounds.scale_max)
    )
    assert np.all(np.diff(scale[:, 0]) >= 0)
    inner = np.geomspace(1.01e-3, 0.79, 40)
    raw = inverse_scale(inner, FORWARD.bounds.scale_min, FORWARD.bounds.scale_max)
    state = start(np.zeros((40, 3)), inner, np.ones(40), FORWARD)
    np.testing.assert_allclose(state.values['scale'][:, 0], raw, rtol=1e-6)


@pytest.mark.parametrize('n', [1, 2, 7])
def test_there_and_back_again(n):
    state = random_state(np.random.default_rng(2), n)
    back = DeviceState(state).host()
    assert len(back) == n
    for group in ('values', 'first', 'second'):
        for k in PARAMETERS:
            np.testing.assert_array_equal(getattr(back, group)[k], getattr(state, group)[k])
    for name in ('gradient', 'visits', 'born'):
        np.testing.assert_array_equal(getattr(back, name), getattr(state, name))


@pytest.mark.parametrize('n', [1, 30])
def test_device_twin_agrees(n):
    state = random_state(np.random.default_rng(3), n)
    state.values['density'][: n // 2] *= 30  # both ends of the softplus
    state.values['scale'][: n // 2] *= 6
    centre, scale, rotation, density = activate(state, FORWARD)
    values = [np.array(x) for x in FORWARD.gaussians(DeviceState(state).values)]
    np.testing.assert_array_equal(values[0].T, centre)
    np.testing.assert_allclose(values[1].T, scale, rtol=2e-6)
    q = values[2].T
    np.testing.assert_allclose(q / np.linalg.norm(q, axis=1, keepdims=True), rotation, atol=1e-6)
    # 1 + exp(raw) rounds to 6e-8 in float32, all that is left of a density far below 1.
    np.testing.assert_allclose(values[3], density, rtol=2e-6, atol=1e-7)


def test_activation_derivatives():
    """The device's derivatives agree with differences on the host; they stay finite if float32 saturates."""
    state = random_state(np.random.default_rng(4), 5)
    device = DeviceState(state)
    dr.enable_grad(list(device.values.values()))
    _, scale, _, density = FORWARD.gaussians(device.values)
    dr.backward(dr.sum(scale.x) + 2 * dr.sum(scale.y) + 3 * dr.sum(scale.z) + dr.sum(density))
    raw = state.values['scale'].astype(float)
    share = 1 / (1 + np.exp(-raw))
    expected = (FORWARD.bounds.scale_max - FORWARD.bounds.scale_min) * share * (1 - share) * [1, 2, 3]
    np.testing.assert_allclose(np.array(dr.grad(device.values['scale'])).T, expected, rtol=1e-5)
    raw = state.values['density'][:, 0].astype(float)
    np.testing.assert_allclose(dr.grad(device.values['density']).numpy(), 1 / (1 + np.exp(-raw)), rtol=1e-5)


@pytest.mark.parametrize('raw', [-90.0, 90.0])
def test_saturated_parameters_have_finite_derivatives(raw):
    state = random_state(np.random.default_rng(5), 3)
    state.values['scale'][:], state.values['density'][:] = raw, raw
    device = DeviceState(state)
    dr.enable_grad(list(device.values.values()))
    _, scale, _, density = FORWARD.gaussians(device.values)
    dr.backward(dr.sum(scale.x) + dr.sum(density))
    for name in ('scale', 'density'):
        assert np.isfinite(np.array(dr.grad(device.values[name]))).all()
        assert np.isfinite(device.host().values[name]).all()


def test_density_has_a_derivative_at_zero():
    state = random_state(np.random.default_rng(6), 3)
    state.values['density'][:] = 0
    device = DeviceState(state)
    dr.enable_grad(list(device.values.values()))
    dr.backward(dr.sum(FORWARD.gaussians(device.values)[3]))
    np.testing.assert_allclose(dr.grad(device.values['density']).numpy(), 0.5, rtol=1e-6)


@pytest.mark.parametrize('nesterov', [False, True])
def test_adam_against_numpy(nesterov):
    rng = np.random.default_rng(7)
    state = random_state(rng, 6)
    for columns in (state.first, state.second):
        for v in columns.values():
            v[:] = 0
    device, rates = DeviceState(state), dict(centre=1e-2, scale=2e-2, rotation=3e-3, density=5e-2)
    method = R2().changed(nesterov=nesterov, **{f'rate_{k}': (rate, rate) for k, rate in rates.items()})
    expected = {k: v.astype(float) for k, v in state.values.items()}
    m, s = ({k: np.zeros_like(v) for k, v in expected.items()} for _ in range(2))
    types = dict(centre=mi.Point3f, scale=mi.Vector3f, rotation=mi.Vector4f, density=mi.Float)
    for step in range(1, 6):
        gradients = {k: np.float32(rng.normal(size=v.shape) * 10.0 ** rng.integers(-4, 2)) for k, v in expected.items()}
        uploaded = {k: types[k](np.ascontiguousarray(g.T if g.shape[1] > 1 else g[:, 0])) for k, g in gradients.items()}
        adam_step(device, uploaded, method, step - 1)
        for k, g in gradients.items():
            g = g.astype(float)
            m[k], s[k] = 0.9 * m[k] + 0.1 * g, 0.999 * s[k] + 0.001 * g * g
            mean = m[k] / (1 - 0.9**step)
            if nesterov:  # Dozat's
                mean = 0.9 * m[k] / (1 - 0.9 ** (step + 1)) + 0.1 * g / (1 - 0.9**step)
            expected[k] -= rates[k] * mean / (np.sqrt(s[k] / (1 - 0.999**step)) + 1e-15)
    actual = device.host()
    for k in PARAMETERS:
        np.testing.assert_allclose(actual.values[k], expected[k], atol=1e-5 * rates[k] * 5 + 2e-6)
        np.testing.assert_allclose(actual.first[k], m[k], rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(actual.second[k], s[k], rtol=1e-4, atol=1e-12)


def test_adam_without_a_derivative_stays_finite():
    """A Gaussian that no view has seen yet: its moments are zero, and zero over epsilon is zero."""
    state = random_state(np.random.default_rng(8), 2)
    for columns in (state.first, state.second):
        for v in columns.values():
            v[:] = 0
    device = DeviceState(state)
    adam_step(device, {'density': dr.zeros(mi.Float, 2)}, R2(), 0)
    np.testing.assert_array_equal(device.host().values['density'], state.values['density'])
