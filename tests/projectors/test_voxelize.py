"""Clouds on voxel grids against the float64 oracle: values, gradients, mass, cut-off."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.projectors.view import vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, random_cloud, relative
from studies.hard_cases.measuring import PARAMETERS, host, on_device

EXTENT = 6.0


def boxed(shape, low=(-1.0, -0.9, -0.8), high=(1.0, 0.95, 0.85)):
    low, high = np.array(low), np.array(high)
    return low, (high - low) / shape, shape


def centres(low, step, shape):
    """Voxel centres [nz * ny * nx, 3], x fastest."""
    z, y, x = np.indices(shape[::-1])
    return low + (np.stack([x, y, z], -1).reshape(-1, 3) + 0.5) * step


def run(cloud, grid, weights, extent=EXTENT):
    low, step, shape = grid
    gaussians = on_device(cloud)
    dr.enable_grad(gaussians)
    values = voxelize(*gaussians, Lattice(vector64(low), vector64(step), shape), extent)
    dr.backward(dr.sum(values * mi.Float(weights.tolist())))
    return values.numpy().astype(float), {n: host(dr.grad(x)) for n, x in zip(PARAMETERS, gaussians)}


def check(cloud, grid):
    points = centres(*grid)
    weights = np.float32(np.random.default_rng(0).normal(size=len(points))).astype(float)
    values, grads = run(cloud, grid, weights)
    expected = oracle.values_at(cloud, points)
    assert relative(values, expected) < 2e-6
    assert np.abs(values - expected).max() < 2e-6 * expected.max()
    for name, value in oracle.value_gradients(cloud, points, weights).items():
        assert relative(grads[name], value) < 1e-5, name


@pytest.mark.parametrize('shape', [(12, 12, 12), (13, 7, 9), (5, 17, 3), (1, 6, 5), (9, 1, 1), (10, 11, 1), (1, 1, 1)])
def test_exact(shape):
    check(random_cloud(np.random.default_rng(1), 8, size=0.2), boxed(shape))


@pytest.mark.slow
def test_exact_at_full_size():
    check(random_cloud(np.random.default_rng(1), 12), boxed((41, 38, 43)))


def test_scene_sized_gaussian_among_small_ones():
    large = Cloud([[0.1, -0.2, 0.05]], [[2.0, 1.5, 1.8]], [[0.1, 0.2, -0.3, 1.0]], [0.4])
    check(large + random_cloud(np.random.default_rng(2), 6, size=0.1), boxed((14, 13, 11)))


def test_needle_and_pancake():
    cloud = Cloud(
        [[0.1, -0.2, 0.05], [-0.2, 0.1, 0.1]],
        [[0.02, 0.02, 0.6], [0.5, 0.5, 0.03]],
        [[0.3, 0.5, -0.2, 0.9], [-0.4, 0.1, 0.6, 0.5]],
        [1.0, 0.6],
    )
    check(cloud, boxed((23, 21, 19)))


def test_gaussians_outside_add_nothing():
    grid, rng = boxed((9, 8, 7)), np.random.default_rng(3)
    inside, weights = random_cloud(rng, 3, size=0.1), rng.normal(size=9 * 8 * 7)
    outside = random_cloud(rng, 5, size=0.1, centre=(4, 0, 0)) + random_cloud(rng, 5, size=0.1, centre=(0, -1e6, 0))
    values, grads = run(inside + outside, grid, weights)
    alone, grads_alone = run(inside, grid, weights)
    np.testing.assert_allclose(values, alone, rtol=1e-6)
    for name in PARAMETERS:
        np.testing.assert_allclose(grads[name][:3], grads_alone[name], rtol=1e-5, atol=1e-6)
        assert not grads[name][3:].any()


def test_mass():
    """The sum of voxels times their volume is rho (2 pi)^1.5 s1 s2 s3: the midpoint rule of a Gaussian is exact."""
    cloud = Cloud([[0.1, -0.05, 0.02]], [[0.1, 0.13, 0.16]], [[0.2, -0.5, 0.3, 0.8]], [0.7])
    low, step, shape = boxed((41, 40, 39))
    values, _ = run(cloud, (low, step, shape), np.ones(41 * 40 * 39))
    mass = 0.7 * (2 * np.pi) ** 1.5 * 0.1 * 0.13 * 0.16
    assert abs(values.sum() * step.prod() - mass) < 2e-6 * mass


def test_order_is_x_fastest():
    cloud = Cloud(
        [[-0.5, 0.1, 0.1], [0.1, 0.5, 0.1], [0.1, 0.1, 0.7]],
        0.1 * np.ones((3, 3)),
        np.tile([0, 0, 0, 1], (3, 1)),
        [1.0, 2, 3],
    )
    values, _ = run(cloud, boxed((10, 10, 10), [-1] * 3, [1] * 3), np.ones(1000))
    volume = values.reshape(10, 10, 10).transpose(2, 1, 0)  # [x, y, z]
    assert volume[2, 5, 5] > 0.99 and volume[5, 7, 5] > 1.99 and volume[5, 5, 8] > 2.99


def test_cut_off():
    """Beyond the extent there is nothing, and within it everything."""
    grid, cloud = boxed((21, 21, 21)), Cloud([[0.03, 0.01, -0.02]], [[0.2, 0.15, 0.25]], [[0.1, 0.2, 0.3, 0.9]], [1.0])
    points = centres(*grid)
    squared = (oracle.whiten(cloud.scale[0], cloud.rotation[0], points - cloud.centre[0]) ** 2).sum(1)
    values, _ = run(cloud, grid, np.ones(len(points)), extent=3.0)
    far, near = squared > 3.5**2, squared < 2.99**2
    expected = oracle.values_at(cloud, points)
    np.testing.assert_allclose(values[near], expected[near], rtol=1e-5)
    # A packet of four neighbours is kept whole, so a little beyond the cut-off survives; it is never anything else.
    assert np.all((values[far] == 0) | (np.abs(values[far] - expected[far]) < 1e-6))


def test_same_bits_every_time(sums_in_order):
    cloud = random_cloud(np.random.default_rng(4), 50) + Cloud([[0, 0, 0]], [[1, 1, 1.2]], [[0, 0.1, 0, 1]], [1.0])
    grid = boxed((17, 16, 15))
    weights = np.random.default_rng(0).normal(size=17 * 16 * 15)
    values, grads = run(cloud, grid, weights)
    for _ in range(3):
        again, grads_again = run(cloud, grid, weights)
        np.testing.assert_array_equal(values, again)
        for name in PARAMETERS:
            np.testing.assert_array_equal(grads[name], grads_again[name])
