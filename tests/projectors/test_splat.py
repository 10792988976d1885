"""Line integrals of clouds of Gaussians against the float64 oracle: images, gradients, tangents, hard places."""

import warnings
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.circles import circle
from helpers.same import assert_same
from helpers.short import short
from lingo_mi.common.errors import AccuracyWarning, InputError
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.rays import Rays
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.depth import deepest
from lingo_mi.projectors.exponential import exp2_of_negative
from lingo_mi.projectors.footprint import NAMES, project
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.splat import splat
from lingo_mi.projectors.usable import require_usable
from lingo_mi.projectors.view import View
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, Pose, random_cloud, relative
from studies.hard_cases.measuring import PARAMETERS, host, on_device

EXTENT = 6.0
POSE = 'source', 'corner', 'u', 'v'


def scanner(mode='cone', shape=(33, 46), angle=33.0, size=(3.2, 3.0), **changes):
    """Rays of one view of a scanner around [-1, 1]^3, and the panel's shape."""
    pixel = [s / n for s, n in zip(size, shape)]
    settings = dict(
        DSO=5.0, DSD=7.5, nDetector=shape, dDetector=pixel, nVoxel=8, dVoxel=0.25, angles=np.radians([angle])
    )
    return circle(**{**settings, 'mode': mode, **changes}).rays(), shape


def tilted(parallel):
    """A panel that is neither square to the beam nor rectangular, rows from bottom to top."""
    forward, u, v = np.array([-1.0, 0.2, 0.1]), np.array([0.2, 0.9, -0.1]), np.array([0.15, -0.2, 1.1])
    shape, centre = (29, 34), 1.7 * forward
    u, v = u * 3 / shape[1], v * 3 / shape[0]
    source = forward / np.linalg.norm(forward) if parallel else -4 * forward
    return Rays(source[None], (centre - u * shape[1] / 2 - v * shape[0] / 2)[None], u[None], v[None], parallel), shape


VIEWS = {
    'cone': scanner(),
    'parallel': scanner('parallel'),
    'cone, offset': scanner(offDetector=(0.31, -0.42), angle=-71.0),
    'parallel, offset': scanner('parallel', offDetector=(0.31, -0.42), angle=-71.0),
    'cone, tall pixels': scanner(shape=(19, 62)),
    'parallel, wide pixels': scanner('parallel', shape=(61, 18)),
    'cone, close': scanner(DSO=2.2, DSD=3.6),
    'cone, tilted': tilted(False),
    'parallel, tilted': tilted(True),
}
SIZES = [(1, 1), (1, 37), (37, 1), (8, 4), (5, 3), (17, 65)]


def run(cloud, frames, shape, weights, pose=False):
    """Image, and derivatives of sum(weights * image) by the cloud and, if asked, by the pose."""
    view, gaussians = View.of(frames, 0, *shape), on_device(cloud)
    dr.enable_grad(gaussians)
    if pose:
        dr.enable_grad([getattr(view, name) for name in POSE])
    image = line_integrals(*gaussians, view, RenderOptions(EXTENT))
    dr.backward(dr.sum(image * mi.Float(weights.tolist())))
    return (
        image.numpy().astype(float),
        {n: host(dr.grad(x)) for n, x in zip(PARAMETERS, gaussians)},
        {n: host(dr.grad(getattr(view, n))).ravel() for n in POSE},
    )


def check(cloud, frames, shape, pose_too=True):
    """Assert the image to 2e-6 and all derivatives to 1e-5."""
    weights = np.float32(np.random.default_rng(0).normal(size=shape[0] * shape[1])).astype(float)
    pose = Pose.of(frames, 0, *shape)
    image, grads, pose_grads = run(cloud, frames, shape, weights, pose_too)
    expected = oracle.line_integrals(cloud, pose)
    assert relative(image, expected) < 2e-6
    assert np.abs(image - expected).max() < 2e-6 * np.abs(expected).max()
    for name, value in oracle.gradients(cloud, pose, weights).items():
        assert grads[name].shape == value.shape
        assert relative(grads[name], value) < 1e-5, name
    if not pose_too:
        return
    for name, value in oracle.pose_gradients(cloud, pose, weights).items():
        pose_grad = pose_grads[name]
        if pose.parallel and name == 'source':  # a unit vector can only turn
            pose_grad, value = (x - x @ pose.source * pose.source for x in (pose_grad, value))
        assert relative(pose_grad, value) < 1e-5, name


@pytest.mark.parametrize(
    'frames, shape', short(VIEWS, ('cone', 'cone, close', 'cone, tilted', 'parallel, offset', 'parallel, wide pixels'))
)
def test_exact(frames, shape):
    check(random_cloud(np.random.default_rng(1), 12), frames, shape)


@pytest.mark.slow
@pytest.mark.parametrize('name', VIEWS)
def test_exact_at_full_size(name):
    frames, _ = VIEWS[name]
    shape = 151, 178
    frames = replace(frames, u=frames.u * 34 / shape[1], v=frames.v * 29 / shape[0])
    check(random_cloud(np.random.default_rng(1), 40), frames, shape, pose_too=False)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('shape', SIZES)
def test_detectors_of_any_size(mode, shape):
    size = (3.2 if shape[0] > 1 else 0.05, 3.0 if shape[1] > 1 else 0.05)
    frames, _ = scanner(mode, shape, size=size)
    check(random_cloud(np.random.default_rng(2), 8, spread=0.3), frames, shape, pose_too=False)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_single_gaussian(mode):
    frames, shape = scanner(mode)
    check(random_cloud(np.random.default_rng(4), 1), frames, shape)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_gaussians_partly_outside_the_image(mode):
    frames, shape = scanner(mode, size=(1.2, 1.1))
    check(random_cloud(np.random.default_rng(5), 20, spread=0.9, size=0.15), frames, shape, pose_too=False)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_gaussians_outside_the_image_add_nothing(mode):
    frames, shape = scanner(mode)
    rng = np.random.default_rng(6)
    seen, weights = random_cloud(rng, 4), rng.normal(size=shape[0] * shape[1])
    # To the sides and far above the fan, but not behind the source.
    beside = random_cloud(rng, 6, spread=0.1, centre=5.5 * frames.u[0] / np.linalg.norm(frames.u[0]))
    above = random_cloud(rng, 6, spread=0.1, centre=(0, 0, 1e3))
    image, grads, _ = run(seen + beside + above, frames, shape, weights)
    alone, grads_alone, _ = run(seen, frames, shape, weights)
    np.testing.assert_allclose(image, alone, rtol=1e-6)
    for name in PARAMETERS:
        largest = np.abs(grads_alone[name]).max()
        np.testing.assert_allclose(grads[name][:4], grads_alone[name], rtol=1e-5, atol=1e-6 * largest)
        assert not grads[name][4:].any()


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_scene_sized_gaussian_among_small_ones(mode):
    frames, shape = scanner(mode)
    large = Cloud([[0.1, -0.2, 0.05]], [[0.5, 0.45, 0.52]], [[0.1, 0.2, -0.3, 1.0]], [0.4])
    check(large + random_cloud(np.random.default_rng(7), 10, size=0.03), frames, shape, pose_too=False)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_quaternions_need_no_unit_length(mode):
    frames, shape = scanner(mode)
    cloud = random_cloud(np.random.default_rng(8), 6)
    weights = np.ones(shape[0] * shape[1])
    image, grads, _ = run(cloud, frames, shape, weights)
    long, long_grads, _ = run(cloud.changed(rotation=64 * cloud.rotation), frames, shape, weights)
    assert_same(image, long)
    np.testing.assert_allclose(64 * long_grads['rotation'], grads['rotation'], rtol=1e-6)


def test_cut_off_bounds_the_error():
    """A smaller extent loses only what lies beyond it, as in the price list of the integrator's docstring."""
    frames, shape = scanner()
    cloud = random_cloud(np.random.default_rng(9), 30)
    exact = oracle.line_integrals(cloud, Pose.of(frames, 0, *shape))
    view, gaussians = View.of(frames, 0, *shape), on_device(cloud)
    errors = [
        relative(line_integrals(*gaussians, view, RenderOptions(extent)).numpy(), exact)
        for extent in (3.0, 4.0, 5.0, 6.0)
    ]
    assert all(error < bound for error, bound in zip(errors, (1.2e-2, 4e-4, 8e-6, 1e-6)))
    assert errors == sorted(errors, reverse=True)


# ------------------------------------------------------------------------------------------------------------
#  Where the footprint is not an ellipse
# ------------------------------------------------------------------------------------------------------------

AHEAD = -np.array([np.cos(np.radians(33)), np.sin(np.radians(33)), 0])  # from the source to the panel's middle
STRADDLING = {
    'source inside': (5 * -AHEAD + 0.05, 0.2),
    'source at the centre': (np.float32(5 * -AHEAD), 0.3),
    'behind the source, reaching ahead': (5.4 * -AHEAD, 0.2),
    'just ahead of the source': (4.6 * -AHEAD, 0.12),
    'through the panel': (2.4 * AHEAD, 0.15),
    'behind the panel, reaching through': (2.9 * AHEAD, 0.15),
    'from source to panel': (0 * AHEAD, 1.2),
    'behind the panel': (3.5 * AHEAD, 0.15),
}


POSE_TOO = 'source inside', 'from source to panel'


@pytest.mark.parametrize('name', STRADDLING)
def test_straddling(name):
    """The integral begins at the source and does not end at the panel, whatever lies in between."""
    middle, size = STRADDLING[name]
    frames, shape = scanner(shape=(21, 26))
    cloud = Cloud([middle], [size * np.array([1, 0.8, 1.3])], [[0.1, 0.4, -0.3, 0.8]], [0.7])
    cloud += random_cloud(np.random.default_rng(1), 3)
    check(cloud, frames, shape, pose_too=name in POSE_TOO)


def test_behind_the_source_adds_nothing():
    frames, shape = scanner()
    cloud = Cloud([6.5 * -AHEAD], [[0.1, 0.1, 0.1]], [[0, 0, 0, 1]], [1.0])
    image, grads, pose = run(cloud, frames, shape, np.ones(shape[0] * shape[1]), pose=True)
    assert not image.any() and not any(g.any() for g in (*grads.values(), *pose.values()))


# ------------------------------------------------------------------------------------------------------------
#  Forward mode
# ------------------------------------------------------------------------------------------------------------


def columns(values):
    """The components of nested Dr.Jit arrays, Float each."""
    return [c for v in values for c in (v if dr.depth_v(v) > 1 else [v])]


def adjoint(function, inputs, directions, rng):
    """Assert <J dx, y> = <dx, J^T y> to 1e-5, for y near J dx, so that neither side cancels."""
    dr.enable_grad(inputs)
    for column, direction in zip(columns(inputs), directions):
        dr.set_grad(column, direction)
    tangent = dr.forward_to(function(inputs)).numpy().astype(float)
    weights = np.float32(tangent + 0.2 * np.std(tangent) * rng.normal(size=len(tangent))).astype(float)
    dr.disable_grad(inputs)
    dr.enable_grad(inputs)
    dr.backward(dr.sum(function(inputs) * mi.Float(weights.tolist())))
    back = sum(
        float((np.array(dr.grad(c), float) * np.array(d, float)).sum()) for c, d in zip(columns(inputs), directions)
    )
    ahead = tangent @ weights
    assert ahead > 0 and abs(ahead - back) < 1e-5 * ahead
    return tangent


@pytest.mark.parametrize('name', VIEWS)
def test_tangent_of_the_splat_is_the_adjoint_of_its_gradient(name):
    frames, shape = VIEWS[name]
    rng = np.random.default_rng(10)
    footprints = project(on_device(random_cloud(rng, 15)), View.of(frames, 0, *shape), EXTENT)
    columns = [np.broadcast_to(v.numpy(), 15) for v in footprints.values]  # a parallel beam's zeros are scalars
    assert len(columns) == len(NAMES)
    values = [mi.Float(c.tolist()) for c in columns]
    # In proportion to each number, whose sizes differ by powers of ten.
    directions = [mi.Float((0.1 * np.abs(c) * rng.normal(size=15)).tolist()) for c in columns]
    adjoint(lambda x: splat(replace(footprints, values=tuple(x)), *shape, EXTENT), values, directions, rng)


@pytest.mark.parametrize('name', ['cone', 'parallel', 'cone, tilted', 'cone, close'])
def test_tangent_of_line_integrals(name):
    """Tangents agree with the gradient and with the oracle, also for a Gaussian around a cone beam's source."""
    frames, shape = VIEWS[name]
    rng = np.random.default_rng(11)
    cloud = random_cloud(rng, 9)
    if name == 'cone':
        cloud += Cloud([frames.source[0]], [[0.2, 0.3, 0.25]], [[0.1, 0.2, 0.3, 0.4]], [0.3])
    n = len(cloud)
    by = dict(
        centre=0.01 * rng.normal(size=(n, 3)),
        scale=0.01 * rng.normal(size=(n, 3)),
        rotation=0.1 * rng.normal(size=(n, 4)),
        density=0.1 * rng.normal(size=n),
    )
    by = {k: np.float32(v).astype(float) for k, v in by.items()}
    directions = [mi.Float(c.tolist()) for v in by.values() for c in (v.T if v.ndim > 1 else [v])]
    view = View.of(frames, 0, *shape)
    tangent = adjoint(
        lambda x: line_integrals(*x, view, RenderOptions(EXTENT)), list(on_device(cloud)), directions, rng
    )
    pose = Pose.of(frames, 0, *shape)
    rays = *pose.rays(), pose.begin
    expected = sum(
        oracle.derivative(
            lambda t: oracle.gaussian_integral([getattr(cloud, k)[i] + t * by[k][i] for k in PARAMETERS], *rays), 1e-2
        )
        for i in range(n)
    )
    assert relative(tangent, expected) < 1e-5


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_derivatives_without_the_image(mode):
    frames, shape = scanner(mode)
    cloud, view = random_cloud(np.random.default_rng(12), 6), View.of(frames, 0, *shape)
    weights = mi.Float(np.random.default_rng(0).normal(size=shape[0] * shape[1]).tolist())
    grads = []
    for primal in (True, False):
        gaussians = on_device(cloud)
        dr.enable_grad(gaussians)
        image = line_integrals(*gaussians, view, RenderOptions(EXTENT), primal)
        assert bool(dr.any(image != 0)) == primal
        dr.backward(dr.sum(image * weights))
        grads.append([host(dr.grad(x)) for x in gaussians])
    for a, b in zip(*grads):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_same_bits_every_time(mode, sums_in_order):
    frames, shape = scanner(mode, (64, 63))
    cloud = Cloud([[0.1, -0.2, 0.05]], [[0.5, 0.45, 0.52]], [[0.1, 0.2, -0.3, 1.0]], [0.4]) + random_cloud(
        np.random.default_rng(13), 300
    )
    weights = np.random.default_rng(0).normal(size=shape[0] * shape[1])
    image, grads, _ = run(cloud, frames, shape, weights)
    for _ in range(4):
        again, grads_again, _ = run(cloud, frames, shape, weights)
        np.testing.assert_array_equal(image, again)
        for name in PARAMETERS:
            np.testing.assert_array_equal(grads[name], grads_again[name])


def test_powers_of_two(variant):
    """They are right to float32's rounding, exact for whole numbers, and small where float32 ends.

    A GPU has its instruction `ex2.approx`, which may err by two units in the last place (PTX ISA, 9.7.3).
    """
    x = np.concatenate([np.linspace(-125.9, 0, 100_001), -np.logspace(-40, 0, 1000), np.arange(-125, 1)]).astype(
        np.float32
    )
    actual = exp2_of_negative(mi.Float(x)).numpy()
    cuda = variant.startswith('cuda')
    np.testing.assert_allclose(actual, np.exp2(x.astype(float)), rtol=(3 if cuda else 1) * 1.2e-7)
    if not cuda:
        np.testing.assert_array_equal(actual[-126:], np.exp2(x[-126:].astype(float)))
    assert np.all(exp2_of_negative(mi.Float([-126, -127, -200, -1e30, -np.inf])).numpy() <= 2.0**-126)


@pytest.mark.parametrize('aspect, warns', [(0.9e6, False), (1.5e6, True)])
def test_needles_are_announced(aspect, warns):
    gaussians = mi.Point3f(0), mi.Vector3f(1, 1, aspect), mi.Vector4f(0, 0, 0, 1), mi.Float(1)
    if warns:
        with pytest.warns(AccuracyWarning, match='Gaussian 0 of here'):
            assert not require_usable(*gaussians, 'here')
    else:
        assert require_usable(*gaussians, 'here')


@pytest.mark.parametrize(
    'name, within, beyond',
    [
        ('centre', 1e12, 1.01e12),
        ('scale', 1e12, 1.01e12),
        ('scale', 1e-12, 0.99e-12),
        ('density', 1e24, 1.01e24),
        ('density', -1e24, -1.01e24),
        ('rotation', 0.51e-15, 0.49e-15),
    ],
)
def test_gaussians_within_the_limits_are_usable(name, within, beyond):
    kinds = dict(centre=mi.Point3f, scale=mi.Vector3f, rotation=mi.Vector4f, density=mi.Float)
    usual = dict(centre=0.0, scale=1.0, rotation=1.0, density=1.0)
    for value, usable in ((within, True), (beyond, False)):
        gaussians = [kind((usual | {name: value})[each]) for each, kind in kinds.items()]
        if usable:
            assert require_usable(*gaussians, 'here')
        else:
            with pytest.raises(InputError, match='Gaussian 0 of here is not usable'):
                require_usable(*gaussians, 'here')


def test_depth_of_items_that_fill_a_cell():
    """8192 items lie in the 64 elements of one cell, 128 at each. As they lie at random, only one in 32 of the cell's
    counts."""
    i = np.arange(8192)
    places = [mi.Int32(p) for p in (i % 8, i // 8 % 8)]
    assert deepest(places, dr.full(mi.Float, 1, 8192), (512, 512)).numpy() == 128
    assert deepest(places, dr.full(mi.Float, 64, 8192), (512, 512)).numpy() == 8192 / 32


@pytest.mark.parametrize('options', [dict(), dict(footprint='affine'), dict(area=True)], ids=str)
@pytest.mark.parametrize('near', [False, True])
def test_gaussians_at_the_source_are_announced_where_options_cannot_hold(options, near):
    frames, shape = scanner()
    centre = frames.source[0] * (0.99 if near else 0.1)
    gaussians = mi.Point3f(*centre.tolist()), mi.Vector3f(0.1), mi.Vector4f(0, 0, 0, 1), mi.Float(1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        dr.eval(line_integrals(*gaussians, View.of(frames, 0, *shape), RenderOptions(EXTENT, **options)))
    messages = [str(w.message) for w in caught if w.category is AccuracyWarning]
    assert len(messages) == (near and bool(options)) and all(text.startswith('1 Gaussians reach') for text in messages)


def test_needles_along_the_ray_that_cannot_be_widened_are_announced():
    """Long needles, thinner than a pixel, have their integrals at the pixels' centres."""
    view = View.of(*scanner_of(1000, 1500, 65, 1.0))
    turn = Rotation.align_vectors([[1, 0, 0]], [[0, 0, 1]])[0].as_quat()
    gaussians = mi.Point3f(0), mi.Vector3f(0.02, 0.02, 100), mi.Vector4f(*turn.tolist()), mi.Float(1)
    expected = line_integrals(*gaussians, view, RenderOptions(5.0)).numpy()
    with pytest.warns(AccuracyWarning, match='1 Gaussians reach'):
        actual = line_integrals(*gaussians, view, RenderOptions(5.0, area=True)).numpy()
    assert expected.max() > 1 and relative(actual, expected) < 1e-4


def scanner_of(DSO, DSD, n, step):
    geometry = CircularGeometry(DSO=DSO, DSD=DSD, nDetector=n, dDetector=step, angles=[0.0], grid=Grid(8, 1))
    return geometry.rays(), 0, n, n


def test_few_items_have_no_depth():
    zeros = dr.zeros(mi.Int32, 10)
    assert deepest((zeros, zeros), dr.full(mi.Float, 4, 10), (8, 8)).numpy() == 0


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_pixels_that_a_footprint_covers(mode):
    """A round one covers pi / 4 of its box."""
    frames, shape = scanner(mode, shape=(90, 90))
    gaussians = mi.Point3f(0), mi.Vector3f(0.1), mi.Vector4f(0, 0, 0, 1), mi.Float(1)
    image = project(gaussians, View.of(frames, 0, *shape), 3.0)
    rows, columns = image.row_end[0] - image.row_begin[0], image.width[0]
    assert rows > 15 and image.area[0] == pytest.approx(np.pi / 4 * rows * columns, rel=0.2)


def test_footprints_are_not_widened_unasked():
    frames, shape = scanner()
    gaussians = mi.Point3f(0.1), mi.Vector3f(0.1, 0.2, 0.3), mi.Vector4f(0, 0, 0, 1), mi.Float(1)
    plain, none, some = (project(gaussians, View.of(frames, 0, *shape), 3.0, *w) for w in ((), (0.0,), (1.0,)))
    for a, b in zip(plain.values, none.values):
        assert a[0] == b[0]
    assert some.values[1][0] < 0.99 * none.values[1][0]


@pytest.mark.parametrize('shape', [(33, 33), (17, 33)])
def test_the_mean_over_a_pixel_widens_a_footprint_by_its_variance(shape):
    """A unit square has the variance 1/12 along each axis: the peak of a round footprint of variances a, b falls by sqrt(a b)."""
    frames, _ = scanner('parallel', shape=shape, size=(3.3, 3.3))
    sigma = 0.15  # in pixels of the panel: the variances a and b
    a, b = ((sigma / np.linalg.norm(step[0])) ** 2 for step in (frames.u, frames.v))
    gaussians = mi.Point3f(0), mi.Vector3f(sigma), mi.Vector4f(0, 0, 0, 1), mi.Float(1)
    view = View.of(frames, 0, *shape)
    centre, mean = (
        line_integrals(*gaussians, view, RenderOptions(EXTENT, area=area)).numpy() for area in (False, True)
    )
    factor = np.sqrt(a * b / ((a + 1 / 12) * (b + 1 / 12)))
    assert centre.max() == pytest.approx(np.sqrt(2 * np.pi) * sigma, rel=1e-5)
    assert mean.max() == pytest.approx(factor * centre.max(), rel=1e-5)
    assert mean.sum() == pytest.approx(centre.sum(), rel=1e-4)
