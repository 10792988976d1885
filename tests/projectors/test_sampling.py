"""Objects of a scene on a grid."""

import numpy as np
import pytest

from lingo_mi.projectors.objects import GridInCube
from lingo_mi.projectors.sampling import on_grid

LOW = np.array([-1.0, 2.0, 3.0])


def grid(values, step=(1.0, 1.0, 1.0)):
    return GridInCube.of(values, LOW, LOW + np.array(values.shape) * step, 'cube')


@pytest.mark.parametrize('over', [2, 3, 4])
@pytest.mark.parametrize('axis', [0, 1, 2])
def test_means_over_larger_voxels(axis, over):
    """Voxels are several times as large along one axis, and no other axis is smoothed."""
    values = np.random.default_rng(0).random((12, 12, 12))
    step, shape = np.ones(3), [12, 12, 12]
    step[axis], shape[axis] = over, 12 // over
    actual = on_grid(grid(values), LOW, step, tuple(shape))
    expected = np.moveaxis(np.moveaxis(values, axis, 0).reshape(-1, over, 12, 12).mean(1), 0, axis)
    np.testing.assert_allclose(actual, expected, rtol=1e-5)


@pytest.mark.parametrize('over', [2, 3, 4])
def test_means_lie_in_the_middle_of_their_voxels(over):
    """This holds for a symmetric object on a grid that is symmetric about it but ends between its voxels, also at its faces."""
    half = np.random.default_rng(1).random((5, 1, 1))
    values = np.concatenate([half, half[::-1]])
    corner, step = LOW + np.array([(10 - 5 * over) / 2, 0, 0]), np.array([over, 1.0, 1.0])
    actual = on_grid(grid(values), corner, step, (5, 1, 1)).ravel()
    np.testing.assert_allclose(actual, actual[::-1], rtol=1e-6)
    assert actual[2] > 0


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_smaller_voxels_are_interpolated_within_the_box(axis):
    """A ramp is held for half a voxel at its ends, and outside there is nothing."""
    values = np.moveaxis(np.broadcast_to(np.arange(1.0, 6)[:, None, None], (5, 4, 3)), 0, axis)
    step, corner, shape = np.ones(3), LOW.copy(), list(values.shape)
    step[axis], shape[axis] = 0.5, 14
    corner[axis] -= 1
    actual = np.moveaxis(on_grid(grid(values), corner, step, tuple(shape)), axis, 0)
    at = (np.arange(14) + 0.5) / 2 - 1  # in voxels from the box's face
    expected = np.where((at > 0) & (at < 5), np.interp(at - 0.5, np.arange(5), np.arange(1.0, 6)), 0)
    np.testing.assert_allclose(actual, np.broadcast_to(expected[:, None, None], actual.shape), rtol=1e-5)
