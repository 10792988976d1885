"""Backpropagation in parts gives the derivatives of the whole."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.geometry.rays import Rays
from lingo_mi.projectors.backprop import Cuts
from lingo_mi.projectors.footprint import project
from lingo_mi.projectors.view import View
from lingo_mi.validation.oracle import random_cloud
from studies.hard_cases.clouds import scanner
from studies.hard_cases.measuring import on_device


def test_values_that_several_parts_use():
    """d/dx of x y (x + sin(x y)) with y = x^2, cut at y and at the product; x is used in all three parts."""
    x = mi.Float(0.3, -1.1, 2.0)
    dr.enable_grad(x)
    cuts = Cuts(True)
    (y,) = cuts(x * x)
    product, again = cuts(x * y, y)
    cuts.pass_on([product * (x + dr.sin(product)) + again], [mi.Float(1, 2, 3)])
    v = x.numpy().astype(float)
    expected = 4 * v**3 + 3 * v**2 * np.sin(v**3) + v**3 * np.cos(v**3) * 3 * v**2 + 2 * v
    np.testing.assert_allclose(dr.grad(x).numpy(), expected * [1, 2, 3], rtol=1e-5)
    assert not cuts.parts


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_the_projection_in_parts(mode):
    """The derivatives of all eleven numbers of a footprint are right, as on a GPU and as on the CPU."""
    frames, shape = scanner(mode)
    assert isinstance(frames, Rays)
    cloud, view = random_cloud(np.random.default_rng(1), 12), View.of(frames, 0, *shape)
    values = []
    for cuts in (Cuts(False), Cuts(True)):
        gaussians = on_device(cloud)
        dr.enable_grad(gaussians)
        footprints = project(gaussians, view, extent=4.0, cut=cuts)
        weights = [dr.cos(type(v)(dr.arange(mi.UInt32, 12) + k)) for k, v in enumerate(footprints.values)]
        cuts.pass_on(footprints.values, weights)
        values.append([np.array(dr.grad(g), float) for g in gaussians])
    for whole, parts in zip(*values):
        assert np.abs(whole).max() > 0
        np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-6 * np.abs(whole).max())
