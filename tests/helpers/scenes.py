"""Helpers of tests of the integrator."""

import mitsuba as mi
import numpy as np

from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import random_cloud

SCANNER = dict(
    type='ct_scanner',
    DSO=5,
    DSD=7.5,
    nDetector='23, 30',
    dDetector='.14, .11',
    offDetector='.1, -.2',
    nVoxel='8',
    dVoxel='.25',
    angles='33',
)
FILM = dict(
    type='hdrfilm', width=26, height=19, rfilter=dict(type='box'), component_format='float32', pixel_format='luminance'
)


def transform():
    return mi.ScalarTransform4f()


def ellipsoids(cloud):
    def tensor(values):
        return mi.TensorXf(np.ascontiguousarray(values, np.float32))

    return dict(
        type='ellipsoids',
        centers=tensor(cloud.centre),
        scales=tensor(cloud.scale),
        quaternions=tensor(cloud.rotation),
        density=tensor(cloud.density[:, None]),
    )


def grid(values, where=None):
    """A cube with the values [x, y, z]."""
    where = where or transform().translate([0.1, 0.2, 0.3]).scale([0.4, 0.5, 0.6])
    data = mi.VolumeGrid(np.ascontiguousarray(values.transpose(2, 1, 0), np.float32)[..., None])
    volume = dict(
        type='gridvolume',
        grid=data,
        raw=True,
        to_world=where @ transform().scale(2) @ transform().translate([-0.5, -0.5, -0.5]),
    )
    return dict(
        type='cube',
        to_world=where,
        bsdf=dict(type='null'),
        interior=dict(type='heterogeneous', albedo=0.0, sigma_t=volume),
    )


def block(sigma=1.3):
    """A turned cuboid of one density."""
    return dict(
        type='cube',
        to_world=transform().translate([-0.3, -0.2, 0.1]).rotate([1, 2, 3], 40).scale([0.2, 0.3, 0.25]),
        bsdf=dict(type='null'),
        interior=dict(type='homogeneous', sigma_t=sigma, albedo=0.0),
    )


def load(objects, sensor=SCANNER, **settings):
    return mi.load_dict(
        dict(type='scene', integrator=dict(type='lingo_xray', extent=6.0, **settings), sensor=sensor, **objects)
    )


def render(scene):
    return np.array(mi.render(scene), float)


def cloud_of(n=6, seed=0):
    return random_cloud(np.random.default_rng(seed), n, size=0.12)


def values_of(shape=(5, 4, 6)):
    return np.random.default_rng(1).random(shape)


def mitsuba_rays(sensor):
    """Mitsuba's own rays through the pixel centres: start and unit direction, [pixels, 3]."""
    width, height = sensor.film().crop_size()
    y, x = np.divmod(np.arange(width * height), width)
    at = mi.Point2f(((x + 0.5) / width).tolist(), ((y + 0.5) / height).tolist())
    ray, _ = sensor.sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    return (np.broadcast_to(np.array(x, float).T, (width * height, 3)) for x in (ray.o, ray.d))


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
