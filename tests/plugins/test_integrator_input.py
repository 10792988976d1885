"""Scenes that the integrator refuses in one line."""

import contextlib

import mitsuba as mi
import numpy as np
import pytest

from helpers.scenes import FILM, SCANNER, block, cloud_of, ellipsoids, grid, load, render, transform, values_of
from lingo_mi.common.errors import InputError


def refused(match, objects=None, sensor=SCANNER, **settings):
    """Assert an InputError in rendering, directly and through `mi.render`."""
    scene = load(dict(cloud=ellipsoids(cloud_of())) if objects is None else objects, sensor, **settings)
    with pytest.raises(InputError, match=match):
        scene.integrator().render(scene, scene.sensors()[0])
    with pytest.raises(InputError, match=match):
        mi.render(scene)


@pytest.mark.parametrize(
    'name, row, value',
    [
        ('rotation', 2, [0, 0, 0, 0]),
        ('rotation', 2, [0, np.nan, 0, 1]),
        ('rotation', 2, [0, np.inf, 0, 1]),
        ('scale', 2, [0.1, -0.1, 0.1]),
        ('scale', 2, [0.1, 0, 0.1]),
        ('scale', 2, [0.1, np.nan, 0.1]),
        ('centre', 2, [np.nan, 0, 0]),
        ('density', 2, np.inf),
    ],
)
def test_unusable_gaussians_are_named(name, row, value):
    cloud = cloud_of()
    values = getattr(cloud, name).copy()
    values[row] = value
    refused("Gaussian 2 of the ellipsoids 'cloud'", dict(cloud=ellipsoids(cloud.changed(**{name: values}))))


@pytest.mark.parametrize('name', ['density', 'second'])
@pytest.mark.parametrize('count', [1, 2])
def test_more_values_than_gaussians(name, count):
    """Mitsuba takes an attribute of any number of components: three densities would be three times the Gaussian."""
    values = mi.TensorXf(np.ones((count, 3), np.float32))
    refused(f'but {3 * count} as {name}', dict(cloud=dict(ellipsoids(cloud_of()[:count]), **{name: values})))


@pytest.mark.parametrize('name, count', [('data', 10), ('data', 20), ('density', 1), ('density', 3)])
def test_updates_of_another_number(name, count):
    scene = load(dict(cloud=ellipsoids(cloud_of()[: 1 if name == 'density' else 4])))
    params = mi.traverse(scene)
    params[f'cloud.{name}'] = mi.Float(np.ones(count))
    with contextlib.suppress(RuntimeError):  # Mitsuba's own refusal, of what its attributes do not divide
        params.update()
    if name == 'density' and count == 1:
        render(scene)
    else:
        with pytest.raises((InputError, RuntimeError), match='one value a Gaussian|same number of entries'):
            render(scene)


def test_missing_density():
    shape = ellipsoids(cloud_of())
    del shape['density']
    refused('\'cloud\' have no attribute "density"', dict(cloud=shape))


def test_grid_outside_a_cube():
    volume_grid = grid(values_of())
    refused('must fill an axis-aligned cube', dict(box=dict(volume_grid, type='sphere', to_world=transform())))
    for turn in (transform().rotate([0, 0, 1], 30), transform().rotate([0, 0, 1], 90), transform().scale([1, -1, 1])):
        refused('must fill an axis-aligned cube', dict(box=grid(values_of(), turn)))
    refused('must fill an axis-aligned cube', dict(box=dict(volume_grid, to_world=transform().scale(0.7))))


def test_an_albedo_may_be_a_grid_of_its_own_place():
    values, where = np.random.default_rng(0).random((4, 5, 6)), transform().translate([1, 0, 0]).scale(3)
    plain, scattering = grid(values), grid(values)
    albedo = grid(np.full((2, 2, 2), 0.5), where)['interior']['sigma_t']
    scattering['interior']['albedo'] = albedo
    np.testing.assert_array_equal(*(render(load(dict(box=volume_grid))) for volume_grid in (plain, scattering)))
    scattering['interior']['sigma_t'], scattering['interior']['albedo'] = albedo, plain['interior']['sigma_t']
    refused('must fill an axis-aligned cube', dict(box=scattering))


@pytest.mark.parametrize('size', [0.01, 1.0, 100.0])
def test_a_grid_turned_by_less_than_can_be_told(size):
    """Some ten thousandths of its size are noticed, and a hundred thousandth is not."""
    turned = [grid(values_of(), transform().scale(size).rotate([0, 0, 1], angle)) for angle in (5e-4, 0.05)]
    render(load(dict(box=turned[0])))
    refused('must fill an axis-aligned cube', dict(box=turned[1]))


def test_homogeneous_sphere():
    refused("'box' has a homogeneous medium, but is not a mesh", dict(box=dict(block(), type='sphere')))


def test_unknown_sensor():
    refused('cannot use the sensor', sensor=dict(type='thinlens', aperture_radius=0.1, focus_distance=3.0, film=FILM))


@pytest.mark.parametrize('extent', [0.5, 21.0, float('nan'), 1e308, 'far', '5'])
def test_extent_out_of_range(extent):
    with pytest.raises(Exception, match='extent is in standard deviations'):
        mi.load_dict(dict(type='lingo_xray', extent=extent))


def test_unknown_output():
    with pytest.raises(Exception, match="'line_integral' or 'transmission'"):
        mi.load_dict(dict(type='lingo_xray', output='photons'))


def test_empty_scene():
    refused('nothing that attenuates', {})
    refused('nothing that attenuates', dict(ball=dict(type='sphere')))
