"""Clouds of Gaussians on curved panels: images, derivatives and tangents against the float64 oracle's lines."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.short import short
from lingo_mi.functional import GaussianProjector, project
from lingo_mi.geometry import CurvedGeometry, Geometry, Grid, PosedGeometry
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.view import View
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, Pose, random_cloud, relative
from studies.hard_cases.measuring import PARAMETERS, host, on_device

EXTENT = 6.0
OPTIONS = RenderOptions(EXTENT)
GRID = Grid(8, 0.25)


def flat(columns=46, width=5.4, **changes):
    """A panel of 33 rows around [-1, 1]^3, an arc of 41 degrees at 7.5."""
    numbers = dict(
        DSO=5.0, DSD=7.5, nDetector=(33, columns), dDetector=(3.2 / 33, width / columns), angles=[0.6], grid=GRID
    )
    return Geometry.cone(**{**numbers, **changes})


def shaken():
    g = flat(tilt=0.2, rotDetector=(0.05, -0.08, 0.2), COR=0.03, offDetector=(0.04, -0.09))
    rays = g.rays()
    return Geometry.from_poses(replace(rays, source=rays.source + [[0.1, -0.06, 0.08]]), g.nDetector, grid=GRID)


SCANNERS = {
    'about the focal spot': flat().curved(),
    'a quarter pixel off': flat(offDetector=(0.2, 5.4 / 46 / 4)).curved(),
    'wide': flat(DSO=2.6, DSD=4.0, width=8.0).curved(),  # 115 degrees
    'a small radius': flat().curved(2.6),
    'a wide radius': flat(offDetector=(-0.3, 0.4)).curved(20.0),
    'flying spot': flat().curved().source_shifted([0.2, -0.1, 0.15]),
    'shaken': CurvedGeometry(flat=shaken(), radius=6.0),
    'few columns': flat(columns=3).curved(),
}


SHORT = 'about the focal spot', 'a wide radius', 'shaken', 'few columns'


@pytest.fixture(params=SCANNERS)
def scanner(request):
    return SCANNERS[request.param]


class Lines(Pose):
    """The rays of a view of a curved panel for the oracle, whatever its own vectors."""

    def rays(self):
        y, x = np.divmod(np.arange(self.height * self.width), self.width)
        return self.of_panel.through(0, x + 0.5, y + 0.5)


def lines(g, rays=None):
    rays = g.rays(curved=True) if rays is None else rays
    pose = Lines(rays.source[0], rays.corner[0], rays.u[0], rays.v[0], *g.nDetector)
    object.__setattr__(pose, 'of_panel', rays)
    return pose


def view(g):
    return View.of(g.rays(curved=True), 0, *g.nDetector)


def cloud_of(name='random', n=40):
    rng = np.random.default_rng(2)
    if name == 'needles':
        cloud = random_cloud(rng, n)
        return cloud.changed(scale=cloud.scale * [[4.0, 0.06, 0.02]])
    return random_cloud(rng, n)


@pytest.mark.parametrize(
    'scanner, name',
    [
        *((scanner, 'random') for scanner in SHORT),
        ('wide', 'needles'),
        *(pytest.param(s, 'random', marks=pytest.mark.thorough) for s in SCANNERS if s not in SHORT),
        *(pytest.param(s, 'needles', marks=pytest.mark.thorough) for s in SCANNERS if s != 'wide'),
    ],
    indirect=['scanner'],
)
def test_images_and_gradients(scanner, name):
    """They are as accurate as on flat panels: `test_splat` has the same tolerance."""
    cloud, pose = cloud_of(name), lines(scanner)
    expected = oracle.line_integrals(cloud, pose)
    weights = np.random.default_rng(0).normal(size=len(expected)).astype(np.float32)
    arguments = on_device(cloud)
    dr.enable_grad(arguments)
    image = line_integrals(*arguments, view=view(scanner), options=OPTIONS)
    assert relative(image.numpy(), expected) < 2e-6
    dr.backward(dr.sum(image * mi.Float(weights)))
    wanted = oracle.gradients(cloud, pose, weights)
    for parameter, argument in zip(PARAMETERS, arguments):
        assert relative(host(dr.grad(argument)), wanted[parameter]) < 5e-5, parameter


def test_a_column_is_a_flat_panel_of_its_own(scanner):
    """Its image is the same to rounding, also for Gaussians that the panel cuts or that reach to the source."""
    rays, (rows, columns) = scanner.rays(curved=True), scanner.nDetector
    cloud = cloud_of() + Cloud(
        np.array([rays.source[0] - 0.02, [0.9, -0.9, 1.2]]),
        [[0.3, 0.2, 0.2], [0.4, 0.4, 0.4]],
        np.eye(4)[:2],
        [1.0, 1.0],
    )
    image = line_integrals(*on_device(cloud), view=view(scanner), options=OPTIONS).numpy().reshape(rows, columns)
    for column in range(0, columns, 7):
        top = rays.points(0, column + 0.5, 0.0)
        poses = replace(rays, corner=(top - rays.u / 2).reshape(1, 3), curve=None)
        one = PosedGeometry(poses=poses, nDetector=(rows, 1), grid=GRID)
        expected = line_integrals(*on_device(cloud), view=view(one), options=OPTIONS).numpy()
        np.testing.assert_allclose(image[:, column], expected, atol=2e-6 * image.max(), rtol=1e-5)


def test_tangents(scanner):
    """The forward-mode derivative is the adjoint of the gradient."""
    arguments = on_device(cloud_of())
    rng = np.random.default_rng(1)
    directions = [type(a)(*rng.normal(size=(len(a), dr.width(a)))) if len(a) < 5 and dr.depth_v(a) > 1
                  else type(a)(rng.normal(size=dr.width(a))) for a in arguments]  # fmt: skip
    dr.enable_grad(arguments)
    for a, d in zip(arguments, directions):
        dr.set_grad(a, d)
    image = line_integrals(*arguments, view=view(scanner), options=OPTIONS)
    tangent = dr.forward_to(image).numpy().astype(float)
    weights = rng.normal(size=len(tangent)).astype(np.float32)
    again = on_device(cloud_of())
    dr.enable_grad(again)
    dr.backward(dr.sum(line_integrals(*again, view=view(scanner), options=OPTIONS) * mi.Float(weights)))
    products = [(host(dr.grad(a)).astype(float) * host(d)).ravel() for a, d in zip(again, directions)]
    actual, expected = tangent @ weights, np.concatenate(products).sum()
    assert abs(actual - expected) < 1e-5 * np.linalg.norm(tangent) * np.linalg.norm(weights)


@pytest.mark.parametrize('scanner', short({name: name for name in SCANNERS}, SHORT), indirect=True)
def test_rigid_motions(scanner):
    """Derivatives by a turn and a shift of source and panel together agree with differences of the oracle."""
    cloud, rays = cloud_of(), scanner.rays(curved=True)
    weights = np.random.default_rng(0).normal(size=np.prod(scanner.nDetector)).astype(np.float32)
    seen = view(scanner)
    pose = seen.source, seen.corner, seen.u, seen.v
    dr.enable_grad(pose)
    dr.backward(dr.sum(line_integrals(*on_device(cloud), view=seen, options=OPTIONS) * mi.Float(weights)))
    gradient = np.array([[float(c[0]) for c in dr.grad(p)] for p in pose])
    actual = rays.by_motion(gradient[None])[0]

    def loss(motion):
        from scipy.spatial.transform import Rotation

        moved = rays.moved(Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:])
        return (weights * oracle.line_integrals(cloud, lines(scanner, moved))).sum()

    expected = [oracle.derivative(lambda by, axis=axis: loss(by * axis), 1e-4) for axis in np.eye(6)]
    assert relative(actual, expected) < 1e-4


def test_functions_of_arrays():
    """`project` of several views agrees with the oracle, and `GaussianProjector` with its transpose."""
    g = flat(angles=[0.6, 2.0, 4.4]).curved()
    cloud = cloud_of()
    columns = cloud.centre, cloud.scale, cloud.rotation, cloud.density
    images = project(*columns, g, extent=EXTENT)
    for index in range(3):
        expected = oracle.line_integrals(cloud, lines(g, g.subset([index]).rays(curved=True)))
        assert relative(images[index], expected) < 2e-6
    A = GaussianProjector(*columns[:3], g, extent=EXTENT)
    y = np.random.default_rng(0).normal(size=images.shape).astype(np.float32)
    assert np.vdot(A(cloud.density), y) == pytest.approx(np.vdot(A.T(y), cloud.density), rel=1e-4)
