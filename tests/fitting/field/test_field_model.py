"""Line integrals and volumes of a field, against the grid projector and against its own densities."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.fields import SMALL, random_state
from helpers.fits import geometry
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.geometry.grid import Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors import grid
from studies.benchmarks.field import NumpyField

# Features of two coarse levels, so that voxels of a 96th resolve the field.
SMOOTH = SMALL.changed(field_levels=2, field_base=3, field_growth=1.5, field_samples=192)
BOXES = [{}, dict(nVoxel=(32, 24, 16), offOrigin=(10.0, -6.0, 4.0)), dict(mode='parallel')]


def views(**changes):
    return geometry(2, **{**dict(nDetector=(12, 14), dDetector=(25.0, 24.0)), **changes})


def rendered(method, g, state=None, unit=1.0):
    return method.model(g, unit).render(DeviceState(state or random_state(method, amplitude=3)), g)


@pytest.mark.parametrize('changes', BOXES)
def test_integrals_are_those_of_the_sampled_field(changes):
    """They agree with the exact projector of the field on fine voxels, up to the voxels' error, which the samples do not
    have."""
    g = views(**changes)
    state = random_state(SMOOTH, amplitude=3)
    fine = g.on(g.grid.finer(3))
    volume = SMOOTH.model(g, 1.0).volume(DeviceState(state), fine.grid)
    expected, actual = grid.project_volume(volume, fine), rendered(SMOOTH, g, state)
    assert volume.std() > 0.01 and (expected > 0).mean() > 0.3
    np.testing.assert_allclose(actual, expected, atol=2e-3 * expected.max())


def test_error_falls_with_the_number_of_samples():
    """Twice the samples quarter it, as in the midpoint rule on smooth functions; the cells' faces cost a little."""
    g, state = views(), random_state(SMOOTH, amplitude=3)
    expected = rendered(SMOOTH.changed(field_samples=1536), g, state)
    errors = [
        np.linalg.norm(rendered(SMOOTH.changed(field_samples=n), g, state) - expected) / np.linalg.norm(expected)
        for n in (12, 24, 48, 96)
    ]
    assert errors[0] < 2e-2
    assert all(b < 0.45 * a for a, b in zip(errors, errors[1:]))


def test_volume_is_the_field_at_the_voxel_centres():
    g, unit = views(nVoxel=(5, 4, 3), dVoxel=(8.0, 9.0, 10.0), offOrigin=(3.0, -2.0, 1.0)), 0.25
    state = random_state(SMALL)
    volume = SMALL.model(g, unit).volume(DeviceState(state))
    side = SMALL.field.field_cube * 40  # of the cube, mm
    axes = [(np.arange(n) + 0.5 - n / 2) * d / side + 0.5 for n, d in zip(g.grid.shape, g.grid.spacing)]
    points = np.stack(np.meshgrid(*axes, indexing='ij'), -1).reshape(-1, 3)
    expected = unit * NumpyField(SMALL.field, state, np.float64).density(points).reshape(g.grid.shape)
    np.testing.assert_allclose(volume, expected, rtol=2e-5)


def test_volume_on_another_grid_is_of_the_same_field_and_empty_outside():
    g, state = views(), DeviceState(random_state(SMALL))
    model = SMALL.model(g, 1.0)
    inner = model.volume(state)
    # Voxels of the same size, shifted by whole ones.
    larger = replace(g.grid, shape=(40, 40, 40), centre=(8.0, 0.0, -8.0))
    outer = model.volume(state, larger)
    inside = np.zeros(larger.shape, bool)
    inside[3:35, 4:36, 5:37] = True
    np.testing.assert_allclose(outer[3:35, 4:36, 5:37], inner, rtol=1e-5)
    assert not outer[~inside].any()


def test_views_do_not_depend_on_the_voxels_of_their_geometry():
    g, state = views(), DeviceState(random_state(SMALL))
    other = replace(g, angles=circular(2, 180, start=10), grid=Grid(8, 8.0, g.grid.centre))
    model = SMALL.model(g, 1.0)
    np.testing.assert_array_equal(model.render(state, other), model.render(state, g))


def test_a_ray_that_misses_the_volume_has_the_integral_0():
    g = views(nDetector=(1, 40), dDetector=(10.0, 40.0))
    image = rendered(SMALL, g)
    assert not image[:, 0, :8].any() and not image[:, 0, -8:].any() and (image[:, 0, 18:22] > 0).all()
