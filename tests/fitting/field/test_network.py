"""The field's densities and derivatives, against NumPy in float64 and against differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.fields import SMALL, random_state
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field.network import Network
from lingo_mi.fitting.methods.naf import NAF
from lingo_mi.projectors.upload import uploaded
from studies.benchmarks.field import NumpyField


@pytest.fixture(params=[{}, dict(field_skip=1, field_layers=3), dict(field_skip=3, field_growth=1.5)])
def method(request):
    return SMALL.changed(**request.param)


@pytest.fixture
def points():
    return np.random.default_rng(1).random((500, 3)).astype(np.float32)


def on_device(points):
    return [uploaded(p) for p in points.T]


def test_density_is_that_of_a_reference_in_float64(method, points):
    state = random_state(method)
    density = Network(method.field).density(DeviceState(state).values, on_device(points)).numpy()
    expected = NumpyField(method.field, state, np.float64).density(points)
    assert expected.std() > 1e-3  # a field that varies
    np.testing.assert_allclose(density, expected, rtol=2e-5)


def test_published_size():
    """The field has 16 levels with 2 features, the three coarsest stored whole, and a network of 4225 numbers."""
    shapes = Network(NAF().field).shapes
    assert shapes == {'features': (2 * (16**3 + 32**3 + 64**3 + 13 * 2**19), 1), 'network': (4225, 1)}


def test_derivatives_are_those_of_a_reference_and_of_differences(method, points):
    """All agree with the reference, one by one; along a random direction, they agree with central differences in float64."""
    state, weights = random_state(method), np.random.default_rng(2).normal(size=len(points)).astype(np.float32)
    values = DeviceState(state).values
    for value in values.values():
        dr.enable_grad(value)
    dr.backward(dr.sum(Network(method.field).density(values, on_device(points)) * uploaded(weights)))
    gradients = {k: dr.grad(v).numpy().astype(float) for k, v in values.items()}

    reference = NumpyField(method.field, state, np.float64)
    reference.density(points)
    features, *layers = reference.gradients(weights.astype(float))
    expected = dict(features=features.ravel(), network=np.concatenate([x.ravel() for x in layers]))
    for name, gradient in expected.items():
        # float32 adds some hundred terms of either sign
        np.testing.assert_allclose(gradients[name], gradient, atol=2e-5 * np.abs(gradient).max())
        direction = np.random.default_rng(3).normal(size=gradient.shape)
        sums = []
        for step in (-1e-6, 1e-6):
            moved = random_state(method)
            moved.values[name] = (moved.values[name][:, 0].astype(float) + step * direction)[:, None]
            sums.append(NumpyField(method.field, moved, np.float64).density(points) @ weights)
        difference = (sums[1] - sums[0]) / 2e-6
        assert gradients[name] @ direction == pytest.approx(difference, rel=2e-3, abs=1e-3 * np.linalg.norm(gradient))


def test_forward_and_backward_derivatives_are_adjoint(points):
    state, rng = random_state(SMALL), np.random.default_rng(4)
    network, values = Network(SMALL.field), DeviceState(state).values
    directions = {k: rng.normal(size=dr.width(v)).astype(np.float32) for k, v in values.items()}
    weights = rng.normal(size=len(points)).astype(np.float32)
    for k, v in values.items():
        dr.enable_grad(v)
        dr.set_grad(v, uploaded(directions[k]))
    forward = dr.forward_to(network.density(values, on_device(points))).numpy().astype(float) @ weights

    values = DeviceState(state).values
    for v in values.values():
        dr.enable_grad(v)
    dr.backward(dr.sum(network.density(values, on_device(points)) * mi.Float(weights)))
    backward = sum(dr.grad(v).numpy().astype(float) @ directions[k] for k, v in values.items())
    assert abs(forward) > 1
    assert forward == pytest.approx(backward, rel=1e-4)
