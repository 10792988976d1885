"""Scenes with a curved panel."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.scenes import SCANNER, block, cloud_of, ellipsoids, grid, load, mitsuba_rays, render, transform, values_of
from lingo_mi.common.errors import InputError
from lingo_mi.functional import project
from lingo_mi.geometry import CurvedGeometry
from lingo_mi.scene.description import describe

CURVED = dict(SCANNER, radius=6.0)


def objects():
    return dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()))


def test_a_cloud():
    """The image equals `lm.project`'s, which other tests compare with single rays."""
    scene, cloud = load(dict(cloud=ellipsoids(cloud_of()))), cloud_of()
    geometry = load({}, CURVED).sensors()[0].geometry
    assert isinstance(geometry, CurvedGeometry)
    expected = project(cloud.centre, cloud.scale, cloud.rotation, cloud.density, geometry, extent=6.0)[0]
    image = render(load(dict(cloud=ellipsoids(cloud)), CURVED))[..., 0]
    np.testing.assert_allclose(image, expected, atol=1e-6 * expected.max())
    assert np.abs(render(scene)[..., 0] - expected).max() > 0.01 * expected.max()  # of the flat panel


def test_rays_are_mitsubas_own():
    """Other integrators ask for the rays of the geometry, also within a crop window."""
    scene = load(objects(), CURVED)
    sensor = scene.sensors()[0]
    rows, columns = sensor.geometry.nDetector
    y, x = np.divmod(np.arange(rows * columns), columns)
    start, direction = sensor.geometry.rays(curved=True).through(0, x + 0.5, y + 0.5)
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    for actual, expected in zip(mitsuba_rays(sensor), (start, direction)):
        np.testing.assert_allclose(actual, expected, atol=1e-6)
    params = mi.traverse(scene)
    params['sensor.film.crop_size'], params['sensor.film.crop_offset'] = [10, 8], [7, 4]
    params.update()
    part = direction.reshape(rows, columns, 3)[4:12, 7:17].reshape(-1, 3)
    np.testing.assert_allclose(list(mitsuba_rays(sensor))[1], part, atol=1e-6)


def test_a_crop_window():
    scene = load(objects(), CURVED)
    whole = render(scene)
    params = mi.traverse(scene)
    params['sensor.film.crop_size'], params['sensor.film.crop_offset'] = [10, 8], [7, 4]
    params.update()
    np.testing.assert_allclose(render(scene), whole[4:12, 7:17], rtol=1e-5, atol=1e-6)


def test_a_grid():
    """A constant grid is a block of that density: its image is the lengths of rays in the box, times it."""
    scene = load(dict(grid=grid(np.full((5, 4, 6), 1.3))), CURVED)
    start, direction = mitsuba_rays(scene.sensors()[0])
    with np.errstate(divide='ignore'):
        a, b = ((np.array([0.1, 0.2, 0.3]) + s * np.array([0.4, 0.5, 0.6]) - start) / direction for s in (-1, 1))
    near, far = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    expected = 1.3 * np.maximum(far - near, 0)
    np.testing.assert_allclose(render(scene).ravel(), expected, atol=3e-6 * expected.max())


def test_a_turned_instance_is_a_turned_scanner():
    group = dict(type='shapegroup', **objects())
    moved = dict(type='instance', shapes=dict(type='ref', id='group'), to_world=transform().rotate([0, 0, 1], -20))
    image = render(load(dict(group=group, moved=moved), CURVED))
    np.testing.assert_allclose(image, render(load(objects(), dict(CURVED, angles='53'))), rtol=1e-5, atol=3e-6)


def test_derivatives():
    """They agree with a finite difference of the image."""
    scene = load(objects(), CURVED)
    params = mi.traverse(scene)
    values = params['cloud.density'].numpy().copy()
    weight = np.random.default_rng(3).random((23, 30, 1))
    dr.enable_grad(params['cloud.density'])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(weight), axis=None))
    gradient = dr.grad(params['cloud.density']).numpy()[2]
    sums = []
    for step in (-0.1, 0.1):
        params['cloud.density'] = mi.Float(values + step * (np.arange(len(values)) == 2))
        params.update()
        sums.append((render(scene) * weight).sum())
    assert gradient == pytest.approx((sums[1] - sums[0]) / 0.2, rel=1e-4)


@pytest.mark.parametrize(
    'things, settings, what',
    [
        (lambda: dict(block=block()), {}, "the mesh 'block'"),
        (objects, dict(pixel=2), 'n x n rays'),
        (lambda: dict(cloud=ellipsoids(cloud_of())), dict(pixel='area'), 'exact footprint'),
        (lambda: dict(objects(), tube=dict(type='xray_tube', energy=60.0)), {}, 'leave out xray_tube'),
    ],
)
def test_what_needs_a_flat_panel(things, settings, what):
    with pytest.raises(InputError, match=what):
        mi.render(load(things(), CURVED, **settings))


def test_a_detector_needs_a_flat_panel():
    with pytest.raises(InputError, match='leave out xray_tube and ct_detector, or the radius'):
        mi.render(load(objects(), dict(CURVED, film=dict(type='ct_detector', photons=1e4))))


def test_it_is_described():
    sensor = load({}, CURVED).sensors()[0]
    again = mi.load_dict(describe(sensor.geometry))
    for name in ('corner', 'u', 'v', 'source'):
        np.testing.assert_allclose(
            getattr(again.geometry.rays(curved=True), name), getattr(sensor.geometry.rays(curved=True), name), atol=1e-9
        )
    assert again.geometry.radius == 6.0
    assert 'radius = 6' in str(sensor)
