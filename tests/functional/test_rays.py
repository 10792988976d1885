"""Images differentiated by the rays: clouds against the float64 oracle, voxels against differences of float64 matrices."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from helpers.matrices import matrix
from lingo_mi.common.errors import InputError
from lingo_mi.functional import Projector, project
from lingo_mi.geometry import CircularGeometry, Geometry, Grid, PosedGeometry, Rays
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Pose, random_cloud, relative

EXTENT = 6.0
GRID = Grid((9, 11, 7), (4.0, 3.0, 5.0), (3.0, -2.0, 1.0))
PANEL = dict(nDetector=(8, 9), grid=GRID)
CONE = dict(DSO=200.0, DSD=300.0, dDetector=(7.0, 6.5), angles=[0.3, 2.0])
BEAM = dict(dDetector=(4.0, 4.0), angles=[0.0, 2.0])  # at 0, rays run along planes of voxel centres
SCANS = {
    'cone': Geometry.cone(**CONE, **PANEL),
    'off centre': Geometry.cone(**CONE, **PANEL, offDetector=(9.0, -14.0), COR=2.0, height=3.0),
    'tilted': Geometry.cone(**CONE, **PANEL, tilt=0.6, rotDetector=(0.1, 0.05, 0.2)),
    'parallel': Geometry.parallel(**BEAM, **PANEL, offDetector=(1.0, -3.0)),
    'laminography': Geometry.parallel(**BEAM, **PANEL, tilt=0.9),
}
each_scan = pytest.mark.parametrize('scan', SCANS.values(), ids=SCANS)


def volume(border=1):
    """Random densities, zero at the faces, so that Joseph's model has no jumps there."""
    return np.pad(np.random.default_rng(1).random(np.array(GRID.shape) - 2 * border), border).astype(np.float32)


def directions(scan, count=3):
    """Changes of all vectors, [count, view, 4, 3], that move what is seen by about a millimetre."""
    out = np.random.default_rng(2).normal(size=(count, *scan.rays().vectors.shape))
    out[:, :, 2:] /= 10
    if scan.mode == 'parallel':
        out[:, :, 0] /= 50
    return out


def by_reverse(function, vectors, weights):
    """Derivatives of sum(weights * function(rays)), [view, 4, 3]."""
    rays = mi.TensorXd(vectors)
    dr.enable_grad(rays)
    dr.backward(dr.sum(function(rays) * mi.TensorXf(weights), axis=None))
    return dr.grad(rays).numpy()


def by_forward(function, vectors, change):
    """The change of images, to first order, for a change of the rays."""
    rays = mi.TensorXd(vectors)
    dr.enable_grad(rays)
    dr.set_grad(rays, mi.TensorXd(change))
    return dr.forward_to(function(rays)).numpy().astype(float)


def tangential(gradient, scan):
    """A gradient without what would lengthen a beam's direction, which changes nothing."""
    if scan.mode == 'cone':
        return gradient
    beam = scan.rays().source
    out = gradient.copy()
    out[:, 0] -= (out[:, 0] * beam).sum(1, keepdims=True) * beam
    return out


def cloud_of(count=9):
    cloud = random_cloud(np.random.default_rng(1), count, spread=9, size=4)
    return cloud, [np.float32(getattr(cloud, n)) for n in ('centre', 'scale', 'rotation', 'density')]


@each_scan
def test_images_of_clouds(scan):
    """Derivatives agree with differences of the float64 oracle, and values equal those for the geometry's own rays."""
    cloud, arrays = cloud_of()
    weights = np.random.default_rng(0).normal(size=(2, *scan.nDetector))
    vectors, tensors = scan.rays().vectors, [mi.TensorXf(x) for x in arrays]
    np.testing.assert_array_equal(project(*arrays, scan, rays=vectors), project(*arrays, scan))
    np.testing.assert_array_equal(
        project(*arrays, scan, views=[1], rays=vectors[1:]), project(*arrays, scan, views=[1])
    )

    def images(rays):
        return project(*tensors, scan, extent=EXTENT, rays=rays)

    actual = by_reverse(images, vectors, weights)
    names = 'source', 'corner', 'u', 'v'
    expected = []
    for i in range(2):
        parts = oracle.pose_gradients(cloud, Pose.of(scan.rays(), i, *scan.nDetector), weights[i].ravel())
        expected.append([parts[name] for name in names])
    expected = tangential(np.array(expected), scan)
    for i, name in enumerate(names):
        assert relative(actual[:, i], expected[:, i]) < 2e-4, name
    for change in directions(scan):
        along = by_forward(images, vectors, change)
        assert (along * weights).sum() == pytest.approx(
            (actual * change).sum(), abs=1e-5 * np.abs(along * weights).sum()
        )


@each_scan
def test_joseph(scan):
    """Derivatives agree with differences of the model's float64 matrix, whose steps are too small to meet a kink."""
    x, vectors = volume(), scan.rays().vectors
    axes = 2 if isinstance(scan, CircularGeometry) or scan is SCANS['off centre'] else 3  # that may be the main one
    A, tensor = Projector(scan), mi.TensorXf(x)
    weights = np.random.default_rng(0).normal(size=A.range_shape)
    np.testing.assert_array_equal(A(x, rays=vectors), A(x))
    gradient = by_reverse(lambda rays: A(tensor, rays=rays), vectors, weights)

    def exact(vectors):
        there = PosedGeometry(poses=Rays.from_vectors(vectors, scan.mode == 'parallel'), **PANEL)
        return (matrix(there, axes) @ x.ravel().astype(float)).reshape(A.range_shape)

    for change in directions(scan, 1):
        expected = (exact(vectors + 1e-6 * change) - exact(vectors - 1e-6 * change)) / 2e-6
        actual = by_forward(lambda rays: A(tensor, rays=rays), vectors, change)
        # Rays that pass a kink of the interpolant within a few ten-thousandths of a voxel have the mean of its two slopes.
        assert np.quantile(np.abs(actual - expected), 0.9) < 1e-4 * np.abs(expected).max()
        assert relative(actual, expected) < 2e-2
        assert (actual * weights).sum() == pytest.approx((gradient * change).sum(), abs=1e-4 * np.abs(actual).sum())


@each_scan
def test_the_exact_model(scan):
    """Derivatives agree with differences of the model, also with density at the faces and from a source within the volume."""
    for some in (scan, *([replace(scan, DSO=8.0, DSD=60.0)] if scan is SCANS['cone'] else [])):
        aligned = scan is SCANS['parallel']  # rays along a face: the image jumps where they leave the box
        x, vectors = volume(int(aligned)), some.rays().vectors
        if not aligned:
            x = x + np.float32(0.5)
        A, tensor = Projector(some, model='exact'), mi.TensorXf(x)
        np.testing.assert_array_equal(A(x, rays=vectors), A(x))
        for change in directions(some):
            actual = by_forward(lambda rays: A(tensor, rays=rays), vectors, change)
            ends = [A(x, rays=vectors + h * change).astype(float) for h in (0.01, -0.01)]
            assert relative(actual, (ends[0] - ends[1]) / 0.02) < 3e-3
            gradient = by_reverse(lambda rays: A(tensor, rays=rays), vectors, actual)
            assert (gradient * change).sum() == pytest.approx((actual**2).sum(), rel=1e-5)


def test_volume_and_rays_together():
    """The derivative by the volume is the transpose at the rays; invalid pixels do not count."""
    scan, x = SCANS['tilted'], volume()
    valid = np.random.default_rng(3).random((2, *scan.nDetector)) < 0.6
    A = Projector(scan, valid=valid)
    vectors = scan.rays().moved(shift=[1.0, 2.0, -1.0]).vectors
    there = Projector(PosedGeometry(poses=Rays.from_vectors(vectors, False), **PANEL), valid=valid)
    rays, tensor = mi.TensorXd(vectors), mi.TensorXf(x)
    dr.enable_grad(rays, tensor)
    images = A(tensor, rays=rays)
    np.testing.assert_array_equal(images.numpy(), there(x))
    y = np.random.default_rng(4).normal(size=A.range_shape).astype(np.float32)
    dr.backward(dr.sum(images * mi.TensorXf(y), axis=None))
    np.testing.assert_allclose(dr.grad(tensor).numpy(), there.T(y), atol=1e-4)
    full = by_reverse(lambda rays: Projector(scan)(mi.TensorXf(x), rays=rays), vectors, np.where(valid, y, 0))
    np.testing.assert_allclose(dr.grad(rays).numpy(), full, rtol=1e-4, atol=1e-4 * np.abs(full).max())


# ---- registration ---------------------------------------------------------------------------------------------


def moved(rays, motion):
    """The rays turned by motion[:3], radians, and shifted by motion[3:], mm: once, or [n, 6] for each view."""
    motion = np.asarray(motion).reshape(-1, 6)
    return rays.moved(Rotation.from_rotvec(motion[:, :3]).as_matrix(), motion[:, 3:])


def registered(images, measured, rays, common):
    """The motion of all views together, or of each, that a gradient method finds when it starts from none."""
    target = mi.TensorXf(measured)
    estimate = rays
    for _ in range(2):  # derivatives are by a small motion: start again from what was found
        begun = estimate

        def loss(step, begun=begun):
            here = moved(begun, step * scale)
            vectors = mi.TensorXd(here.vectors)
            dr.enable_grad(vectors)
            off = dr.sum(dr.square(images(vectors) - target), axis=None)
            dr.backward(off)
            gradient = here.by_motion(dr.grad(vectors).numpy())
            return float(off.array[0]), ((gradient.sum(0) if common else gradient.ravel()) * scale)

        scale = np.tile([0.02, 0.02, 0.02, 1, 1, 1], 1 if common else len(rays))  # radians are longer than millimetres
        step = minimize(loss, np.zeros(len(scale)), jac=True, method='L-BFGS-B', options=dict(maxiter=22)).x * scale
        estimate = moved(begun, step)
    return estimate


def true_object():
    """A known object: voxels of three blobs, and the same as a cloud."""
    grid = Grid((20, 20, 20), 2.0)
    means = np.array([[8.0, 3, -5], [-6, 7, 4], [0, -9, 6]], np.float32)
    cloud = [means, np.float32([[4, 3, 5]] * 3), np.tile(np.float32([0, 0, 0, 1]), (3, 1)), np.ones(3, np.float32)]
    axis = (np.arange(20) - 9.5) * 2
    points = np.stack(np.meshgrid(axis, axis, axis, indexing='ij'), -1)
    values = sum(np.exp(-0.5 * (((points - m) / s) ** 2).sum(-1)) for m, s in zip(cloud[0], cloud[1]))
    return grid, cloud, values.astype(np.float32)


@pytest.mark.parametrize('common', [True, False], ids=['all views', 'each view'])
@pytest.mark.parametrize('of', ['cloud', 'voxels'])
def test_a_shift_and_a_turn_are_recovered(of, common):
    """Half a millimetre and one degree, of all views together or of each, are found to a fiftieth."""
    (grid, cloud, values), views = true_object(), 2
    scan = Geometry.cone(
        DSO=300, DSD=450, nDetector=(16, 16), dDetector=3.75, angles=np.linspace(0.2, 2.2, views), grid=grid
    )
    rng = np.random.default_rng(6)
    motion = rng.normal(size=(1 if common else views, 6))
    motion[:, :3] *= np.radians(1) / np.linalg.norm(motion[:, :3], axis=1, keepdims=True)
    motion[:, 3:] *= 0.5 / np.linalg.norm(motion[:, 3:], axis=1, keepdims=True)
    true = moved(scan.rays(), motion)
    if of == 'cloud':
        tensors = [mi.TensorXf(x) for x in cloud]
        measured = project(*cloud, scan, rays=true.vectors)
        recovered = registered(lambda rays: project(*tensors, scan, rays=rays), measured, scan.rays(), common)
    else:
        A, tensor = Projector(scan, model='exact'), mi.TensorXf(values)
        measured = A(values, rays=true.vectors)
        recovered = registered(lambda rays: A(tensor, rays=rays), measured, scan.rays(), common)
    before, after = (np.linalg.norm(r.source - true.source, axis=1).max() for r in (scan.rays(), recovered))
    assert before > 2 and after < 0.02 * before
    turn = np.linalg.norm(recovered.u - true.u, axis=1).max() / np.linalg.norm(scan.rays().u[0])
    assert turn < 0.02 * np.radians(1)


# ---- kinds of arrays, and bad input ------------------------------------------------------------------------------


@pytest.mark.parametrize('kind', ['torch', 'jax'])
@pytest.mark.parametrize('of', ['cloud', 'voxels'])
def test_frameworks(kind, of):
    module = pytest.importorskip(kind, reason=f'{kind} is not installed')
    scan = SCANS['tilted']
    A, (_, arrays) = Projector(scan), cloud_of()
    vectors = scan.rays().vectors
    weights = np.random.default_rng(0).normal(size=A.range_shape).astype(np.float32)
    values = arrays if of == 'cloud' else [volume()]

    def images(rays, *x):
        return project(*x, scan, rays=rays) if of == 'cloud' else A(*x, rays=rays)

    expected = by_reverse(lambda rays: images(rays, *map(mi.TensorXf, values)), vectors, weights)
    close = dict(rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    if kind == 'torch':
        rays = module.tensor(vectors, requires_grad=True)
        out = images(rays, *map(module.tensor, values))
        (out * module.tensor(weights)).sum().backward()
        assert rays.grad.dtype == module.float64
        np.testing.assert_allclose(rays.grad, expected, **close)
        np.testing.assert_array_equal(out.detach(), images(vectors, *values))
        return

    def loss(rays):
        return (images(rays, *map(module.numpy.asarray, values)) * weights).sum()

    gradient = module.grad(loss)(module.numpy.asarray(vectors))  # float32
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    with module.enable_x64(True):
        gradient = module.jit(module.grad(loss))(module.numpy.asarray(vectors))
        assert gradient.dtype == 'float64'
        np.testing.assert_allclose(gradient, expected, **close)


def _without(value, at=(1, 0, 2)):
    out = SCANS['cone'].rays().vectors
    out[at] = value
    return out


@pytest.mark.parametrize(
    'rays, message',
    [
        (SCANS['cone'].rays(), 'give geometry.rays().vectors'),
        (SCANS['cone'], 'give geometry.rays().vectors'),
        (SCANS['cone'].rays().vectors[:1], 'rays must be of the shape [2, 4, 3], not [1, 4, 3]'),
        (SCANS['cone'].rays().vectors.reshape(2, 12), 'rays must be of the shape [2, 4, 3], not [2, 12]'),
        (_without(np.nan), 'the pose of view 1 holds NaN'),
        (_without(0, (0, 2)), 'the pose of view 0 has steps u and v shorter'),
        ('text', 'rays cannot be read as an array'),
    ],
)
def test_bad_rays(rays, message):
    x = volume()
    scan, cloud = SCANS['cone'], cloud_of()[1]
    for function in (lambda: Projector(scan)(x, rays=rays), lambda: project(*cloud, scan, rays=rays)):
        with pytest.raises(InputError) as caught:
            function()
        assert message in str(caught.value) and '\n' not in str(caught.value) and len(str(caught.value)) < 300


def test_arrays_of_several_kinds():
    vectors = mi.TensorXd(SCANS['cone'].rays().vectors)
    with pytest.raises(InputError, match='the volume of NumPy, rays of Dr.Jit'):
        Projector(SCANS['cone'])(volume(), rays=vectors)
    with pytest.raises(InputError, match='one kind, not means of NumPy'):
        project(*cloud_of()[1], SCANS['cone'], rays=vectors)


def test_a_batch_has_no_rays():
    with pytest.raises(InputError, match=r'the volume must be of the shape \[9, 11, 7\], not \[2, 9, 11, 7\]'):
        Projector(SCANS['cone'])(np.stack([volume()] * 2), rays=SCANS['cone'].rays().vectors)
