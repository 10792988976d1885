"""The integrator `lingo_xray` through Mitsuba's own interface: images, derivatives, sensors, updates, files, errors."""

import contextlib
import os
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.same import assert_same
from helpers.scenes import SCANNER, block, cloud_of, ellipsoids, grid, load, mitsuba_rays, render, transform, values_of
from lingo_mi.common.errors import InputError
from lingo_mi.files.ply import write_ply
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.state import start
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.projectors.sensors import view_of
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, relative

FILM = dict(
    type='hdrfilm', width=26, height=19, rfilter=dict(type='box'), component_format='float32', pixel_format='luminance'
)


# ------------------------------------------------------------------------------------------------------------
#  Scenes
# ------------------------------------------------------------------------------------------------------------


def pose(sensor, view=0):
    g = scanner_geometry(sensor)
    return oracle.Pose.of(g.rays(), view, *g.nDetector)


def scanner_geometry(sensor=SCANNER):
    def numbers(name):
        return [float(x) for x in sensor[name].split(',')]

    return CircularGeometry(
        DSO=sensor['DSO'],
        DSD=sensor['DSD'],
        angles=np.radians(numbers('angles')),
        **{name: numbers(name) for name in ('nDetector', 'dDetector', 'offDetector')},
        grid=Grid(8, 0.25),
    )


def everything():
    return dict(cloud=ellipsoids(cloud_of()), more=ellipsoids(cloud_of(3, 5)), grid=grid(values_of()), block=block())


@pytest.fixture(params=['mono', 'rgb'])
def colour(request, variant):
    """The variant under test, and its twin in colour."""
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
    """Both ways to write the same cuboid, projected by different code, and its chords in NumPy."""
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
#  Sensors
# ------------------------------------------------------------------------------------------------------------


def cameras():
    oblique = transform().look_at([3, 1, 0.5], [0, 0.1, 0], [0.1, 0, 1])
    crop = dict(FILM, width=41, height=33, crop_offset_x=7, crop_offset_y=4, crop_width=26, crop_height=19)
    return {
        'perspective': dict(type='perspective', fov=40, to_world=oblique, film=FILM),
        'principal point': dict(
            type='perspective',
            fov=40,
            to_world=oblique,
            film=FILM,
            principal_point_offset_x=0.13,
            principal_point_offset_y=-0.21,
        ),
        'perspective, crop': dict(
            type='perspective',
            fov=45,
            to_world=oblique,
            film=crop,
            principal_point_offset_x=-0.1,
            principal_point_offset_y=0.05,
        ),
        'fov of y': dict(type='perspective', fov=40, fov_axis='y', to_world=oblique, film=FILM),
        'orthographic': dict(type='orthographic', to_world=oblique @ transform().scale(1.1), film=FILM),
        'orthographic, crop': dict(type='orthographic', to_world=oblique @ transform().scale([1.1, 1.1, 1]), film=crop),
        'cone': SCANNER,
        'parallel': dict(SCANNER, mode='parallel'),
    }


@pytest.mark.parametrize(
    'name',
    [
        'perspective',
        'principal point',
        'perspective, crop',
        'fov of y',
        'orthographic',
        'orthographic, crop',
        'cone',
        'parallel',
    ],
)
def test_rays_are_the_sensors_own(name):
    sensor = mi.load_dict(cameras()[name])
    view = view_of(sensor)
    vectors = (np.array(x, float).ravel() for x in (view.source, view.corner, view.u, view.v))
    start, direction = oracle.Pose(*vectors, view.height, view.width, view.parallel).rays()
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    o, d = mitsuba_rays(sensor)
    np.testing.assert_allclose(direction, d, atol=1e-6)
    # Mitsuba's rays start on the near plane or at the panel, but on the same line.
    off = np.cross(o - start, d)
    assert np.abs(off).max() < 1e-5

    cloud = cloud_of()
    expected = sum(oracle.gaussian_integral(row, start, direction) for row in oracle.rows(cloud))
    assert relative(render(load(dict(cloud=ellipsoids(cloud)), cameras()[name])), expected) < 2e-6


def test_one_view_of_a_scanner():
    scene = load(dict(cloud=ellipsoids(cloud_of())), dict(SCANNER, angles='33, 120, -45', view=1))
    scanner = scene.sensors()[0]
    for i in range(3):
        image = np.array(mi.render(scene, sensor=scanner.view(i)), float)
        sensor = dict(SCANNER, angles='33, 120, -45')
        assert relative(image, oracle.line_integrals(cloud_of(), pose(sensor, i))) < 2e-6
        if i == 1:
            assert_same(image, render(scene))


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
    """The image's derivative along a direction in all parameters at once."""
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


# ------------------------------------------------------------------------------------------------------------
#  Axes
# ------------------------------------------------------------------------------------------------------------

BLOBS = {'x': (30.0, 0.0, 0.0), 'y': (0.0, 40.0, 0.0), 'z': (0.0, 0.0, 50.0)}  # mm


def expected_pixel(point, angle, g):
    """Column and row of a point by hand, for a cone beam at 0 or 90 degrees."""
    x, y, z = point
    across, towards = {0: (y, x), 90: (-x, y)}[angle]
    m = g.DSD / (g.DSO - towards) if g.mode == 'cone' else 1
    off_v, off_u = g.offDetector
    return (
        g.nDetector[1] / 2 + (m * across - off_u) / g.dDetector[1],
        g.nDetector[0] / 2 + (off_v - m * z) / g.dDetector[0],
    )


def middle(image):
    row, column = np.indices(image.shape) + 0.5
    return (image * column).sum() / image.sum(), (image * row).sum() / image.sum()


def asymmetric(mode, offset):
    return CircularGeometry(
        DSO=400.0,
        DSD=600.0,
        nDetector=(120, 100),
        dDetector=(2.1, 2.7),
        angles=np.radians([0.0, 90.0]),
        mode=mode,
        offDetector=(13.0, -9.0) if offset else (0.0, 0.0),
        grid=Grid((40, 44, 48), (4.0, 4.0, 4.0), (6.0, -7.0, 8.0) if offset else (0.0, 0.0, 0.0)),
    )


@pytest.mark.parametrize('offset', [False, True])
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('axis', BLOBS)
def test_axes(axis, mode, offset):
    """u is +y at 0 and -x at 90 degrees, rows run down, in Mitsuba's images, in scans, and in volumes [x, y, z]."""
    from lingo_mi.plugins.ct_scanner import describe

    g, point = asymmetric(mode, offset), np.array(BLOBS[axis])
    blob = Cloud([point], [[4, 4, 4]], [[0, 0, 0, 1]], [0.1])
    images = [render(load(dict(cloud=ellipsoids(blob)), describe(g, i)))[..., 0] for i in range(2)]
    for image, angle in zip(images, (0, 90)):
        np.testing.assert_allclose(middle(image), expected_pixel(point, angle, g), atol=0.05)

    method = R2().changed(extent=6.0, scale_min=1e-4, scale_max=0.5)
    normalised = (point - g.grid.centre) * g.grid.scale
    state = DeviceState(start(normalised[None], np.array([4 * g.grid.scale]), np.array([0.1]), method.forward))
    model = method.model(g, 1.0)
    np.testing.assert_allclose(model.render(state, g), images, rtol=2e-4, atol=1e-5)

    volume = model.volume(state)
    assert volume.shape == g.grid.shape
    mean = [(volume * i).sum() / volume.sum() for i in np.indices(volume.shape)]
    np.testing.assert_allclose(mean, (point - g.grid.centre) / 4 + np.array(g.grid.shape) / 2 - 0.5, atol=0.01)


# ------------------------------------------------------------------------------------------------------------
#  Files and import order
# ------------------------------------------------------------------------------------------------------------

XML = """<scene version="3.0.0">
    <integrator type="lingo_xray"><float name="extent" value="6"/></integrator>
    <sensor type="ct_scanner">
        <float name="DSO" value="5"/> <float name="DSD" value="7.5"/>
        <string name="nDetector" value="23, 30"/> <string name="dDetector" value=".14, .11"/>
        <string name="offDetector" value=".1, -.2"/> <string name="angles" value="33"/>
        <string name="nVoxel" value="8"/> <string name="dVoxel" value=".25"/>
    </sensor>
    <shape type="ellipsoids"><string name="filename" value="cloud.ply"/></shape>
    <shape type="cube">
        <transform name="to_world"><scale x=".4" y=".5" z=".6"/><translate x=".1" y=".2" z=".3"/></transform>
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <float name="albedo" value="0"/>
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="grid.vol"/> <boolean name="raw" value="true"/>
                <transform name="to_world">
                    <translate x="-.5" y="-.5" z="-.5"/><scale value="2"/>
                    <scale x=".4" y=".5" z=".6"/><translate x=".1" y=".2" z=".3"/>
                </transform>
            </volume>
        </medium>
    </shape>
    <shape type="cube">
        <transform name="to_world">
            <scale x=".2" y=".3" z=".25"/><rotate x="1" y="2" z="3" angle="40"/><translate x="-.3" y="-.2" z=".1"/>
        </transform>
        <bsdf type="null"/>
        <medium name="interior" type="homogeneous">
            <float name="sigma_t" value="1.3"/> <float name="albedo" value="0"/>
        </medium>
    </shape>
</scene>"""


@pytest.fixture
def scene_file(tmp_path):
    cloud = cloud_of()
    write_ply(tmp_path / 'cloud.ply', cloud.centre, cloud.scale, cloud.rotation, cloud.density)
    mi.VolumeGrid(np.float32(values_of().transpose(2, 1, 0))[..., None]).write(str(tmp_path / 'grid.vol'))
    path = tmp_path / 'scene.xml'
    path.write_text(XML)
    return path


def test_scene_file(scene_file):
    expected = render(load(dict(cloud=ellipsoids(cloud_of()), grid=grid(values_of()), block=block())))
    assert relative(render(mi.load_file(str(scene_file))), expected) < 2e-6


ORDERS = (
    'import lingo_mi, mitsuba as mi; mi.set_variant("{}")',
    'import mitsuba as mi; mi.set_variant("{}"); import lingo_mi',
    'import mitsuba as mi; mi.set_variant("scalar_rgb"); import lingo_mi; mi.set_variant("{}")',
)


@pytest.mark.parametrize(
    'order, kind',
    [
        pytest.param(order, kind, marks=() if (order, kind) == (ORDERS[2], 'rgb') else pytest.mark.thorough)
        for order in ORDERS
        for kind in ('mono', 'rgb')
    ],
)
def test_either_import_order(order, kind, scene_file, variant):
    name = variant.rsplit('_', 1)[0] + '_' + kind
    code = f'{order.format(name)}\nimport numpy\nprint(numpy.array(mi.render(mi.load_file({str(scene_file)!r}))).sum())'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, env=os.environ, timeout=120)
    assert done.returncode == 0, done.stderr
    assert abs(float(done.stdout) / render(mi.load_file(str(scene_file))).sum() - 1) < 1e-6


def test_plugins_describe_themselves():
    scene = load(everything())
    assert 'LingoXray' in str(scene) and 'CTScanner' in str(scene)


# ------------------------------------------------------------------------------------------------------------
#  Errors
# ------------------------------------------------------------------------------------------------------------


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
    """Ten thousandth parts of its size are, a hundred thousandth part is not."""
    turned = [grid(values_of(), transform().scale(size).rotate([0, 0, 1], angle)) for angle in (5e-4, 0.05)]
    render(load(dict(box=turned[0])))
    refused('must fill an axis-aligned cube', dict(box=turned[1]))


def test_homogeneous_sphere():
    refused("'box' has a homogeneous medium, but is not a mesh", dict(box=dict(block(), type='sphere')))


def test_unknown_sensor():
    refused('cannot use the sensor', sensor=dict(type='thinlens', aperture_radius=0.1, focus_distance=3.0, film=FILM))


def test_unknown_key_of_a_scanner():
    with pytest.raises(Exception, match='DS0'):
        mi.load_dict(dict(SCANNER, DS0=3))


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


@pytest.mark.parametrize(
    'change, match',
    [
        (dict(view=3), 'view 3'),
        (dict(nDetector='23.5, 30'), 'whole numbers'),
        (dict(dDetector='a'), 'not a list of numbers'),
        (dict(DSD=2.0), 'DSD >= DSO'),
        (dict(mode='fan'), 'mode must be'),
        (dict(angles='nan'), 'angles must be finite numbers'),
        (dict(angles=''), 'no views'),
    ],
)
def test_impossible_scanners(change, match):
    with pytest.raises(Exception, match=match):
        mi.load_dict(dict(SCANNER, **change))
