"""Sensors through `lingo_xray`: their rays, where a scanner puts what it sees, and impossible scanners."""

import mitsuba as mi
import numpy as np
import pytest

from helpers.same import assert_same
from helpers.scenes import FILM, SCANNER, cloud_of, ellipsoids, load, mitsuba_rays, pose, render, transform
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.state import start
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.projectors.sensors import view_of
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, relative


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


def test_unknown_key_of_a_scanner():
    with pytest.raises(Exception, match='DS0'):
        mi.load_dict(dict(SCANNER, DS0=3))


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
