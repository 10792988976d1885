"""Scenes as Mitsuba's users write them: films, crops, instances, batches, nested integrators, variants."""

import gc
import inspect

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.effects import direct, kernels
from helpers.same import assert_same
from helpers.scenes import SCANNER, block, cloud_of, ellipsoids, grid, load, mitsuba_rays, render, transform, values_of
from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import find_effects

FILM = dict(
    type='hdrfilm', width=60, height=23, rfilter=dict(type='box'), component_format='float32', pixel_format='luminance'
)


def camera(y=1.0):
    where = transform().look_at([3, y, 0.5], [0, 0.1, 0], [0.1, 0, 1])
    return dict(type='perspective', fov=40, to_world=where)


def everything():
    return dict(block=block(), cloud=ellipsoids(cloud_of()), grid=grid(values_of()))


def instance(to_world, objects=None):
    group = dict(type='shapegroup', **(everything() if objects is None else objects))
    return dict(group=group, moved=dict(type='instance', shapes=dict(type='ref', id='group'), to_world=to_world))


# ------------------------------------------------------------------------------------------------------------
#  Film
# ------------------------------------------------------------------------------------------------------------


def test_the_film_has_the_image():
    scene = load(everything())
    for _ in range(2):  # a second image replaces the first
        image = render(scene)
    np.testing.assert_allclose(np.array(scene.sensors()[0].film().bitmap()), image[..., 0], rtol=1e-6)


@pytest.mark.parametrize('pixel_format', ['rgb', 'rgba'])
def test_a_film_in_colour_has_the_image(pixel_format, variant):
    mi.set_variant(variant.rsplit('_', 1)[0] + '_rgb')
    try:
        scene = load(everything(), dict(camera(), film=dict(FILM, pixel_format=pixel_format)))
        image, actual = render(scene), np.array(scene.sensors()[0].film().bitmap())
        np.testing.assert_allclose(actual[..., :3], image[..., :3], rtol=1e-6)
        assert pixel_format == 'rgb' or (actual[..., 3] == 1).all()
    finally:
        mi.set_variant(variant)


def test_the_film_costs_no_kernel():
    scene = load(everything())
    assert kernels(lambda: dr.eval(mi.render(scene))) == kernels(lambda: direct(scene))


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_crop_window_of_a_scanner(mode):
    scene = load(everything(), dict(SCANNER, mode=mode))
    whole = render(scene)
    params = mi.traverse(scene)
    params['sensor.film.crop_size'], params['sensor.film.crop_offset'] = [10, 8], [7, 4]
    params.update()
    part = render(scene)
    np.testing.assert_allclose(part, whole[4:12, 7:17], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.array(scene.sensors()[0].film().bitmap()), part[..., 0], rtol=1e-6)


def test_film_of_another_size():
    scene = load(everything())
    params = mi.traverse(scene)
    params['sensor.film.size'] = [10, 8]
    params.update()
    with pytest.raises(InputError, match='change nDetector'):
        mi.render(scene)


def test_crop_window_of_a_detector():
    scene = load(everything(), dict(SCANNER, film=dict(type='ct_detector', photons=1e4)))
    params = mi.traverse(scene)
    params['sensor.film.crop_size'] = [10, 8]
    params.update()
    with pytest.raises(InputError, match='crop the image'):
        mi.render(scene)


# ------------------------------------------------------------------------------------------------------------
#  Instances
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_turned_instance_is_a_turned_scanner(mode):
    """For every kind of object, a turn by -20 degrees about the axis is an angle of 20 degrees more."""
    scanner = dict(SCANNER, mode=mode)
    image = render(load(instance(transform().rotate([0, 0, 1], -20)), scanner))
    np.testing.assert_allclose(image, render(load(everything(), dict(scanner, angles='53'))), rtol=1e-5, atol=3e-6)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_sheared_instance_is_a_sheared_mesh(mode):
    where = transform().translate([0.1, -0.05, 0.2]).rotate([0, 1, 1], 30).scale([0.9, 1.2, -0.7])
    sheared = dict(block(), to_world=where @ block()['to_world'])
    scanner = dict(SCANNER, mode=mode)
    image = render(load(instance(where, dict(block=block())), scanner))
    np.testing.assert_allclose(image, render(load(dict(block=sheared), scanner)), rtol=1e-5, atol=3e-6)


def test_instances_add_up():
    twice = dict(instance(transform()), other=dict(type='instance', shapes=dict(type='ref', id='group')))
    np.testing.assert_allclose(render(load(twice)), 2 * render(load(everything())), rtol=1e-6)


def test_derivative_by_the_place_of_an_instance():
    """Along z, it is the sum of the derivatives by all centres of the same cloud outside a group."""
    weight = mi.TensorXf(np.random.default_rng(0).random((23, 30, 1)).astype(np.float32))
    cloud = dict(cloud=ellipsoids(cloud_of()))

    def backward(scene, params):
        params.update()
        dr.backward(dr.sum(mi.render(scene, params) * weight, axis=None))

    z = mi.Float(0)
    dr.enable_grad(z)
    moved = load(instance(transform(), cloud))
    params = mi.traverse(moved)
    params['moved.to_world'] = mi.AffineTransform4f().translate([0, 0, z])
    backward(moved, params)

    plain = load(cloud)
    params = mi.traverse(plain)
    dr.enable_grad(params['cloud.data'])
    backward(plain, params)
    expected = np.array(dr.grad(params['cloud.data'])).reshape(-1, 10)[:, 2].sum()
    np.testing.assert_allclose(np.array(dr.grad(z)), expected, rtol=1e-4)


def test_scatter_needs_shapes_outside_groups():
    from lingo_mi.projectors.objects import find_objects
    from lingo_mi.projectors.sampling import bounds
    from lingo_mi.scene.truth import true_volume

    scene = load(instance(transform()))
    with pytest.raises(InputError, match='put the shape into the scene itself'):
        bounds(find_objects(scene))
    assert find_effects(scene, scene.sensors()[0]) is None
    assert true_volume(find_objects(scene), scene.sensors()[0].geometry.grid) is None


# ------------------------------------------------------------------------------------------------------------
#  Batches
# ------------------------------------------------------------------------------------------------------------


def test_batch_of_scanners():
    views = [dict(SCANNER, angles=angle) for angle in ('33', '50')]
    batch = dict(type='batch', first=views[0], second=views[1], film=FILM)
    scene = load(everything(), batch)
    image = render(scene)
    assert_same(image, np.concatenate([render(load(everything(), view)) for view in views], 1))
    np.testing.assert_allclose(np.array(scene.sensors()[0].film().bitmap()), image[..., 0], rtol=1e-6)


def test_batch_of_views():
    """The derivatives of a batch of one scanner's views equal the derivatives of single views."""
    scanner = mi.load_dict(dict(SCANNER, angles='33, 50, 120'))
    batch = dict(type='batch', film=dict(FILM, width=90), **{f'v{i}': scanner.view(i) for i in range(3)})
    scene = load(dict(cloud=ellipsoids(cloud_of())), batch)
    params = mi.traverse(scene)
    density = params['cloud.density']
    dr.enable_grad(density)
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) ** 2, axis=None))
    together = np.array(dr.grad(density))
    dr.set_grad(density, 0)
    for i in range(3):
        dr.backward(dr.sum(mi.render(scene, params, sensor=scanner.view(i)) ** 2, axis=None))
    np.testing.assert_allclose(together, np.array(dr.grad(density)), rtol=1e-5)


def test_batch_of_cameras():
    """The rays of each are those that Mitsuba's own integrators take through its part of the film."""
    from lingo_mi.projectors.sensors import views_of
    from lingo_mi.validation import oracle

    batch = mi.load_dict(dict(type='batch', film=FILM, first=camera(), second=camera(-1.0)))
    _, directions = mitsuba_rays(batch)
    parts = np.split(directions.reshape(23, 60, 3), 2, axis=1)
    for (_, view), part in zip(views_of(batch), parts, strict=True):
        vectors = (np.array(x, float).ravel() for x in (view.source, view.corner, view.u, view.v))
        _, along = oracle.Pose(*vectors, view.height, view.width, view.parallel).rays()
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        np.testing.assert_allclose(along, part.reshape(-1, 3), atol=1e-6)


def test_batch_without_a_film():
    with pytest.raises(InputError, match='give a batch of n scanners a film of n times 30 x 23'):
        mi.render(load(everything(), dict(type='batch', first=SCANNER, second=SCANNER)))


# ------------------------------------------------------------------------------------------------------------
#  What does not work says so
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('kind', ['rectangle', 'disk', 'sphere', 'cylinder'])
def test_medium_in_a_shape_that_is_no_mesh(kind):
    with pytest.raises(InputError, match="'block' has a homogeneous medium, but is not a mesh"):
        mi.render(load(dict(block=dict(block(), type=kind, to_world=transform()))))


def test_derivatives_by_vertices():
    scene = load(dict(block=block()))
    params = mi.traverse(scene)
    dr.enable_grad(params['block.vertex_positions'])
    params.update()
    with pytest.raises(InputError, match="do not reach the vertices of the mesh 'block'"):
        mi.render(scene, params)
    dr.disable_grad(params['block.vertex_positions'])
    params.update()
    assert render(scene).any()


@pytest.mark.parametrize('outer', [dict(type='aov', aovs='depth:depth'), dict(type='moment')])
def test_within_another_integrator(outer):
    scene = mi.load_dict(
        dict(type='scene', integrator=dict(outer, image=dict(type='lingo_xray')), sensor=SCANNER, **everything())
    )
    with pytest.raises(InputError, match='renders whole images, no single rays'):
        mi.render(scene)


def test_within_a_frozen_function():
    scene = load(everything())

    @dr.freeze
    def frozen(factor):
        return mi.render(scene) * factor

    gc.collect()  # Dr.Jit's recording does not bear objects of other tests that go meanwhile
    with pytest.raises(RuntimeError) as caught:  # Dr.Jit puts its own exception around ours
        frozen(mi.Float(2))
    assert isinstance(caught.value.__cause__, InputError) and 'dr.freeze' in str(caught.value.__cause__)
    assert render(scene).any()


def test_render_keeps_its_help():
    assert inspect.signature(mi.render) == inspect.signature(mi.util.render)
    assert mi.render.__doc__ == mi.util.render.__doc__


def test_variant_without_derivatives(variant):
    mi.set_variant('scalar_rgb')
    try:
        with pytest.raises(RuntimeError, match='does not work in scalar_rgb: .* llvm_ad_mono, llvm_ad_rgb'):
            mi.load_dict(dict(type='lingo_xray'))
    finally:
        mi.set_variant(variant)
