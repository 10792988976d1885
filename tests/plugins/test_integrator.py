"""The integrator `lingo_xray` through Mitsuba's own interface: images, derivatives, updates."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.scenes import (
    FILM,
    SCANNER,
    block,
    cloud_of,
    ellipsoids,
    everything,
    grid,
    load,
    pose,
    render,
    transform,
    values_of,
)
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import relative


@pytest.fixture(params=['mono', 'rgb'])
def colour(request, variant):
    """The kind of the active variant: the variant under test, then its twin in colour."""
    mi.set_variant(variant.rsplit('_', 1)[0] + '_' + request.param)
    yield request.param
    mi.set_variant(variant)


# ------------------------------------------------------------------------------------------------------------
#  Images
# ------------------------------------------------------------------------------------------------------------


def test_ellipsoids(colour):
    image = render(load(dict(cloud=ellipsoids(cloud_of()))))
    assert image.shape == (23, 30, 1)
    assert relative(image, oracle.line_integrals(cloud_of(), pose(SCANNER))) < 2e-6


def test_objects_add_up(colour):
    parts = everything()
    total = sum(render(load({name: shape})) for name, shape in parts.items())
    assert relative(render(load(parts)), total) < 1e-6


def test_transmission(colour):
    parts = everything()
    np.testing.assert_allclose(render(load(parts, output='transmission')), np.exp(-render(load(parts))), rtol=1e-6)


def test_constant_grid_is_a_block():
    """Two ways to write the same cuboid, projected by different code, agree with its chords in NumPy."""
    where = transform().translate([0.1, 0.2, 0.3]).scale([0.4, 0.5, 0.6])
    solid = dict(
        type='cube', to_world=where, bsdf=dict(type='null'), interior=dict(type='homogeneous', sigma_t=0.7, albedo=0.0)
    )
    start, direction = pose(SCANNER).rays()
    with np.errstate(divide='ignore'):
        a, b = ((np.array([0.1, 0.2, 0.3]) + s * np.array([0.4, 0.5, 0.6]) - start) / direction for s in (-1, 1))
    chord = np.maximum(np.maximum(a, b).min(1) - np.minimum(a, b).max(1), 0) * np.linalg.norm(direction, axis=1)
    for shape in (grid(np.full((5, 4, 6), 0.7), where), solid):
        image = render(load(dict(box=shape)))
        np.testing.assert_allclose(image.ravel(), 0.7 * chord, rtol=1e-5, atol=3e-6)


def test_channels_of_the_film(colour):
    sensor = dict(
        type='perspective',
        fov=40,
        film=dict(FILM, pixel_format='rgb'),
        to_world=transform().look_at([3, 1, 0.5], [0, 0, 0], [0, 0, 1]),
    )
    image = render(load(dict(cloud=ellipsoids(cloud_of())), sensor))
    assert image.shape == (19, 26, 3 if colour == 'rgb' else 1)
    np.testing.assert_array_equal(image[..., 0], image[..., -1])


# ------------------------------------------------------------------------------------------------------------
#  Derivatives
# ------------------------------------------------------------------------------------------------------------


def test_scene_gradients(colour):
    for output in ('line_integral', 'transmission'):
        objects = dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()), block=block())
        scene = load(objects, output=output)
        params = mi.traverse(scene)
        keys = ['cloud.data', 'cloud.density', 'grid.interior_medium.sigma_t.data']
        keys += [k for k, _ in params.items() if k.startswith('block') and 'sigma_t' in k and colour == 'mono']
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        weights = np.float32(np.random.default_rng(2).normal(size=(23, 30, 1))).astype(float)
        image = mi.render(scene, params)
        dr.backward(dr.sum(image * mi.TensorXf(np.float32(weights)), axis=None))
        plain = render(load(objects))
        # d exp(-p) = -exp(-p) dp
        slope = (weights if output == 'line_integral' else -weights * np.exp(-plain)).ravel()

        expected = oracle.gradients(cloud_of(), pose(SCANNER), slope)
        data = dr.grad(params['cloud.data']).numpy().reshape(-1, 10)
        for name, columns in (('centre', slice(3)), ('scale', slice(3, 6)), ('rotation', slice(6, 10))):
            assert relative(data[:, columns], expected[name]) < 1e-5, name
        assert relative(dr.grad(params['cloud.density']).numpy(), expected['density']) < 1e-5

        # Integrals are linear in the grid's values, so a large step has no error but rounding.
        gradient = np.array(dr.grad(params[keys[2]]), float)[..., 0].transpose(2, 1, 0)
        norm = np.linalg.norm(gradient)
        for index in [(0, 0, 0), (2, 3, 1), (4, 3, 5), (1, 2, 3)]:
            unit = np.zeros((5, 4, 6))
            unit[index] = 1
            change = render(load(dict(grid=grid(unit)))).ravel() @ slope
            assert abs(gradient[index] - change) < 1e-5 * norm
        if colour == 'mono':
            change = render(load(dict(block=block(1.0)))).ravel() @ slope
            assert abs(dr.grad(params[keys[3]]).numpy().item() / change - 1) < 1e-5


def test_forward_mode():
    """It gives the image's derivative along a direction in all parameters at once."""
    rng = np.random.default_rng(3)
    cloud, values = cloud_of(), values_of()
    by = {k: 0.01 * rng.normal(size=getattr(cloud, k).shape) for k in ('centre', 'scale', 'rotation', 'density')}
    by_grid = rng.normal(size=values.shape)
    rays = pose(SCANNER).rays()
    d_cloud = sum(
        oracle.derivative(
            lambda t: oracle.gaussian_integral([getattr(cloud, k)[i] + t * by[k][i] for k in by], *rays), 1e-2
        )
        for i in range(len(cloud))
    )
    d_line = d_cloud + render(load(dict(grid=grid(by_grid)))).ravel()
    for output in ('line_integral', 'transmission'):
        objects = dict(cloud=ellipsoids(cloud), grid=grid(values))
        scene = load(objects, output=output)
        params = mi.traverse(scene)
        data = np.concatenate([by['centre'], by['scale'], by['rotation']], 1).ravel()
        change = np.float32(by_grid.transpose(2, 1, 0)[..., None])
        for key, direction in (
            ('cloud.data', mi.Float(data.tolist())),
            ('cloud.density', mi.Float(by['density'].tolist())),
            ('grid.interior_medium.sigma_t.data', mi.TensorXf(change)),
        ):
            dr.enable_grad(params[key])
            dr.set_grad(params[key], direction)
        params.update()
        image = np.array(dr.forward_to(mi.render(scene, params)), float).ravel()
        expected = d_line if output == 'line_integral' else -np.exp(-render(load(objects)).ravel()) * d_line
        assert relative(image, expected) < 1e-5


# ------------------------------------------------------------------------------------------------------------
#  Updates
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('name', ['centre', 'scale', 'rotation', 'density', 'all', 'fewer'])
def test_updated_cloud_is_a_new_cloud(name):
    old, new = cloud_of(), cloud_of(seed=9)
    if name == 'fewer':
        new = new[:4]
    elif name != 'all':
        new = old.changed(**{name: getattr(new, name)})
    scene = load(dict(cloud=ellipsoids(old)))
    render(scene)
    params = mi.traverse(scene)
    params['cloud.data'] = mi.Float(np.concatenate([new.centre, new.scale, new.rotation], 1).ravel().tolist())
    params['cloud.density'] = mi.Float(new.density.tolist())
    params.update()
    np.testing.assert_allclose(render(scene), render(load(dict(cloud=ellipsoids(new)))), rtol=1e-6, atol=1e-9)


def test_updated_grid_and_blocks():
    scene = load(dict(grid=grid(values_of()), block=block(), other=dict(block(0.5), to_world=transform().scale(0.1))))
    before = render(scene)
    params = mi.traverse(scene)
    key = 'grid.interior_medium.sigma_t.data'
    params[key] = 2 * params[key]
    params['block.interior_medium.sigma_t.value.value'] = 2.6
    params['other.interior_medium.sigma_t.value.value'] = 1.0
    params.update()
    np.testing.assert_allclose(render(scene), 2 * before, rtol=1e-5, atol=1e-6)


def test_meshes_are_prepared_once(monkeypatch):
    from lingo_mi.projectors import mesh

    prepared, prepare = [], mesh.from_mitsuba
    monkeypatch.setattr(mesh, 'from_mitsuba', lambda shape: prepared.append(shape.id()) or prepare(shape))
    scene = load(dict(block=block(), other=dict(block(0.5), to_world=transform().scale(0.1))))
    for _ in range(3):
        render(scene)
    assert sorted(prepared) == ['block', 'other']


def test_moved_mesh():
    scene = load(dict(block=block()))
    render(scene)
    params = mi.traverse(scene)
    positions = mi.Point3f(dr.unravel(mi.Point3f, params['block.vertex_positions'])) + mi.Vector3f(0.2, 0.1, 0.3)
    params['block.vertex_positions'] = dr.ravel(positions)
    params.update()
    moved = dict(block(), to_world=transform().translate([0.2, 0.1, 0.3]) @ block()['to_world'])
    np.testing.assert_allclose(render(scene), render(load(dict(block=moved))), rtol=1e-5, atol=3e-6)


def test_plugins_describe_themselves():
    scene = load(everything())
    assert 'LingoXray' in str(scene) and 'CTScanner' in str(scene)
