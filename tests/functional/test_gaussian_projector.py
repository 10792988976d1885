"""`GaussianProjector`: its images equal `project`'s, and its transpose is one, on arrays of every kind; bad input."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.sparse.linalg import lsqr

from lingo_mi.common.errors import InputError
from lingo_mi.functional import GaussianProjector, project
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.validation.oracle import random_cloud

PANEL = dict(nDetector=(12, 15), grid=Grid(10, 4.0), angles=[0.2, 1.4, 3.0])
SCANS = {
    'cone': Geometry.cone(DSO=200, DSD=300, dDetector=5.0, **PANEL),
    'parallel': Geometry.parallel(dDetector=4.0, **PANEL),
    'tilted': Geometry.cone(DSO=200, DSD=300, dDetector=5.0, tilt=0.5, **PANEL),
    'source within': Geometry.cone(DSO=5, DSD=60, dDetector=3.0, **PANEL),  # some have no footprint
}
CLOUD = random_cloud(np.random.default_rng(1), 9, spread=9, size=4)
SHAPES = [np.float32(getattr(CLOUD, name)) for name in ('centre', 'scale', 'rotation')]


def pair(A, batch=()):
    rng = np.random.default_rng(0)
    shapes = (*batch, *A.domain_shape), (*batch, *A.range_shape)
    return [rng.normal(size=shape).astype(np.float32) for shape in shapes]


@pytest.mark.parametrize('scan', SCANS.values(), ids=SCANS)
def test_images_and_transpose(scan):
    A = GaussianProjector(*SHAPES, scan)
    x, y = pair(A)
    images = A(x)
    np.testing.assert_allclose(images, project(*SHAPES, x, scan), atol=1e-6 * np.abs(images).max())
    off = abs(np.vdot(images.astype(float), y) - np.vdot(x, A.T(y).astype(float)))
    assert off < 1e-6 * np.linalg.norm(images) * np.linalg.norm(y) and A.T.T is A
    columns = A(np.eye(9, dtype=np.float32))  # one by one
    np.testing.assert_allclose(np.einsum('n,n...->...', x, columns), images, atol=2e-5 * np.abs(images).max())


def test_least_squares():
    A = GaussianProjector(*SHAPES, SCANS['cone'], extent=4)
    x, _ = pair(A)
    np.testing.assert_allclose(lsqr(A.aslinearoperator(), A(x).ravel())[0], x, atol=1e-3)
    assert repr(A.T) == 'GaussianProjector(9 Gaussians to 3 x 12 x 15 pixels).T'


@pytest.mark.parametrize('kind', ['drjit', 'torch', 'jax'])
def test_kinds_of_arrays(kind):
    module = pytest.importorskip(kind, reason=f'{kind} is not installed') if kind != 'drjit' else None
    A = GaussianProjector(*SHAPES, SCANS['tilted'])
    x, y = pair(A, (2,))
    expected = A.T(A(x) - y)
    close = dict(rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    if kind == 'jax':
        actual = module.grad(lambda x: ((A(x) - y) ** 2).sum() / 2)(module.numpy.asarray(x))
        np.testing.assert_allclose(actual, expected, **close)
        return
    array = mi.TensorXf(x) if kind == 'drjit' else module.tensor(x, requires_grad=True)
    if kind == 'drjit':
        dr.enable_grad(array)
        dr.backward(dr.sum(dr.square(A(array) - mi.TensorXf(y)), axis=None) / 2)
        np.testing.assert_allclose(dr.grad(array).numpy(), expected, **close)
        return
    ((A(array) - module.tensor(y)) ** 2).sum().backward()
    np.testing.assert_allclose(array.grad / 2, expected, **close)


@pytest.mark.parametrize('value', [np.nan, np.inf])
@pytest.mark.parametrize('kind', ['torch', 'jax'])
def test_gradients_that_are_not_finite(kind, value):
    module = pytest.importorskip(kind, reason=f'{kind} is not installed')
    A = GaussianProjector(*SHAPES, SCANS['cone'])
    x, _ = pair(A)
    if kind == 'torch':
        x = module.tensor(x, requires_grad=True)
        (A(x) * value).sum().backward()
        gradient = x.grad
    else:
        gradient = module.grad(lambda x: (A(x) * value).sum())(module.numpy.asarray(x))
    assert not np.isfinite(np.asarray(gradient)).any()


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda g: GaussianProjector(*SHAPES, None), 'geometry must be a Geometry'),
        (
            lambda g: GaussianProjector(SHAPES[0][:, :2], *SHAPES[1:], g),
            'means must be of the shape [N, 3], not [9, 2]',
        ),
        (
            lambda g: GaussianProjector(*SHAPES[:2], SHAPES[2][:4], g),
            'quaternions must be of the shape [9, 4], not [4, 4]',
        ),
        (lambda g: GaussianProjector(*(x[:0] for x in SHAPES), g), 'the cloud is empty'),
        (lambda g: GaussianProjector(SHAPES[0] * np.nan, *SHAPES[1:], g), 'Gaussian 0 of the arrays given to'),
        (lambda g: GaussianProjector(*SHAPES, g, extent=0), 'extent is in standard deviations'),
        (lambda g: GaussianProjector(*SHAPES, g)(np.ones(8)), 'takes arrays [..., 9], not [8]'),
        (lambda g: GaussianProjector(*SHAPES, g)(np.full(9, np.inf)), 'NaN or infinity'),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(InputError) as caught:
        make(SCANS['cone'])
    assert message in str(caught.value) and '\n' not in str(caught.value)
