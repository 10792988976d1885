"""`functional.Projector`: values against `project_volume`, its transpose for every beam, and arrays of every kind."""

from __future__ import annotations

import copy
import gc
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.sparse.linalg import lsqr

from helpers.grids import scan
from helpers.motions import climbing, curved, posed, reversed_panel, rolled, shaken, tilted, turned
from lingo_mi.common.errors import InputError
from lingo_mi.functional import Projector
from lingo_mi.geometry import Geometry
from lingo_mi.projectors.grid import project_volume

GEOMETRIES = {
    'cone': scan(n=3),
    'parallel': scan('parallel', n=3),
    'one slice': scan(n=3, nVoxel=(9, 11, 1), nDetector=(1, 21)),
    'far off': scan(n=3, offOrigin=(30.0, -20.0, 9.0), offDetector=(-30.0, 14.0)),
    'source in the volume': scan(n=3, DSO=10.0, DSD=60.0),
    **{motion.__name__: posed(motion) for motion in (climbing, shaken, turned, reversed_panel, rolled)},
    'tilted': posed(tilted(0.6, 0.0, 0.0)),
    'tilted parallel': posed(tilted(1.3, 0.2, 0.0), 'parallel'),
    'curved': curved(),
    'curved, another radius': curved(radius=170.0),
    'curved, climbing': curved(climbing),
    'curved, tilted': curved(tilted(0.6, 0.0, 0.0)),
    'curved, flying spot': curved().source_shifted([[-5.0, 2.0, 1.0], [5.0, -2.0, -1.0], [0.0, 0.0, 4.0]]),
    'curved, source in the volume': curved(DSO=10.0, DSD=300.0),
}
KINDS = 'numpy', 'drjit', 'torch', 'jax'


def framework(kind):
    module = pytest.importorskip(kind, reason=f'{kind} is not installed') if kind in ('torch', 'jax') else None
    if kind == 'torch' and device() == 'cuda' and not module.cuda.is_available():
        pytest.skip('PyTorch has no GPU')
    return module


def device():
    return 'cuda' if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else 'cpu'


def array_of(kind, x):
    module = framework(kind)
    if kind == 'numpy':
        return x
    if kind == 'drjit':
        return mi.TensorXf(x)
    return module.tensor(x, device=device()) if kind == 'torch' else module.numpy.asarray(x)


def host(x):
    return np.asarray(x.detach().cpu() if hasattr(x, 'detach') else x)


def pair(shape_x, shape_y, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape_x).astype(np.float32), rng.normal(size=shape_y).astype(np.float32)


def off(A, x, y):
    """Return the difference of A.T from the transpose of A, relative to |A x| |y|."""
    ax, aty = A(x).astype(float), A.T(y).astype(float)
    return abs(np.vdot(ax, y) - np.vdot(x, aty)) / (np.linalg.norm(ax) * np.linalg.norm(y))


@pytest.mark.parametrize('masked', [False, True])
@pytest.mark.parametrize('model', ['joseph', 'exact'])
@pytest.mark.parametrize('geometry', GEOMETRIES.values(), ids=GEOMETRIES)
def test_transpose(geometry, model, masked):
    valid = np.random.default_rng(1).random((3, *geometry.nDetector)) < 0.7 if masked else None
    A = Projector(geometry, model=model, valid=valid)
    x, y = pair(A.domain_shape, A.range_shape)
    assert off(A, x, y) < 1e-6 and A.T.T is A
    exact = project_volume(x, geometry) if valid is None else np.where(valid, project_volume(x, geometry), 0)
    if A.model == 'exact':
        np.testing.assert_allclose(A(x), exact, atol=1e-5 * np.abs(exact).max())
    if masked:
        assert not A(x)[~valid].any()
        expected = A.T(np.where(valid, y, 0))
        y[~valid] = 1e6
        np.testing.assert_allclose(A.T(y), expected, atol=1e-5 * np.abs(expected).max())  # sums in any order


def test_the_models():
    """Joseph's model has an error. If it does not serve a scan, the projector takes the exact one, and says so."""
    assert Projector(GEOMETRIES['cone']).model == 'joseph' == Projector(GEOMETRIES['tilted']).model
    assert Projector(GEOMETRIES['source in the volume']).model == 'exact'
    smooth = np.add.outer(np.add.outer(np.sin(np.arange(9) / 3), np.cos(np.arange(11) / 3)), np.ones(7))
    joseph, exact = (Projector(GEOMETRIES['cone'], model=m)(smooth) for m in ('joseph', 'exact'))
    assert 1e-4 < np.linalg.norm(joseph - exact) / np.linalg.norm(exact) < 0.05


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('batch', [(), (2,), (2, 1)])
def test_kinds_of_arrays(kind, batch):
    A = Projector(GEOMETRIES['cone'])
    x, y = pair((*batch, *A.domain_shape), (*batch, *A.range_shape))
    for linear_map, values in ((A, x), (A.T, y)):
        array = array_of(kind, values)
        actual = linear_map(array)
        wanted = np.array([linear_map(v) for v in values.reshape(-1, *linear_map.domain_shape)])
        assert isinstance(actual, type(array)) and host(actual).dtype == np.float32
        np.testing.assert_allclose(
            host(actual), wanted.reshape(*batch, *linear_map.range_shape), atol=1e-6 * np.abs(wanted).max()
        )
    if kind == 'torch':
        assert actual.device == array.device and actual.is_contiguous()


def test_flat_arrays_of_drjit():
    A = Projector(GEOMETRIES['cone'])
    x, _ = pair(A.domain_shape, A.range_shape)
    actual = A(mi.Float(x.ravel()))
    assert isinstance(actual, mi.Float)
    np.testing.assert_array_equal(actual.numpy(), A(x).ravel())
    np.testing.assert_array_equal(A(dr.ones(mi.TensorXf, A.domain_shape)).numpy(), A(np.ones(A.domain_shape)))


def test_derivatives_of_drjit():
    A = Projector(GEOMETRIES['cone'])
    x, y = pair((2, *A.domain_shape), (2, *A.range_shape))
    tensor = mi.TensorXf(x)
    dr.enable_grad(tensor)
    dr.backward(dr.sum(A(tensor) * mi.TensorXf(y), axis=None))
    np.testing.assert_allclose(dr.grad(tensor).numpy(), A.T(y), atol=1e-5)
    tensor = mi.TensorXf(x)
    dr.enable_grad(tensor)
    dr.set_grad(tensor, 2.0)
    change = dr.forward_to(A(tensor))
    np.testing.assert_allclose(change.numpy(), A(np.full_like(x, 2)), rtol=1e-5, atol=1e-4)


def test_derivatives_of_torch():
    """Derivatives are taken in reverse twice, forward, vectorised, and all together; in float64 they agree with differences."""
    torch = framework('torch')
    A = Projector(GEOMETRIES['cone'])
    x, y = (array_of('torch', v) for v in pair(A.domain_shape, A.range_shape))
    assert_close = torch.testing.assert_close

    def loss(x):
        return ((A(x) - y) ** 2).sum() / 2

    def gradient(x):
        return torch.autograd.grad(loss(x), x, create_graph=True)[0]

    with_grad = x.clone().requires_grad_()
    g = gradient(with_grad)
    assert_close(g, A.T(A(x) - y), rtol=1e-5, atol=1e-3)
    v = torch.ones_like(x)
    assert_close(torch.autograd.grad((g * v).sum(), with_grad)[0], A.T(A(v)), rtol=1e-5, atol=1e-3)
    out, tangent = torch.func.jvp(A, (x,), (v,))
    assert_close((out, tangent), (A(x), A(v)), rtol=1e-5, atol=1e-4)
    many = torch.stack([x, 2 * x, v])
    assert_close(torch.func.vmap(A)(many), A(many))
    assert_close(torch.func.vmap(A, in_dims=3)(many.movedim(0, 3)), A(many))
    assert_close(torch.func.vmap(torch.func.grad(loss))(many)[1], A.T(A(2 * x) - y), rtol=1e-5, atol=1e-3)
    hessian_v = torch.func.jvp(torch.func.grad(loss), (x,), (v,))[1]
    assert_close(hessian_v, A.T(A(v)), rtol=1e-5, atol=1e-3)


def test_tensors_of_other_types_and_layouts():
    torch = framework('torch')
    A = Projector(GEOMETRIES['cone'])
    x, _ = pair(A.domain_shape, A.range_shape)
    t = array_of('torch', x)
    strided = torch.empty((*reversed(A.domain_shape),), device=t.device).permute(2, 1, 0).copy_(t)
    shifted = torch.empty(x.size + 1, device=t.device)[1:].view(A.domain_shape).copy_(t)  # not aligned as Dr.Jit's
    for other in (strided, shifted, t.double(), torch.nn.Parameter(t)):
        torch.testing.assert_close(A(other).detach(), A(t))
    torch.testing.assert_close(A(t.half()), A(t), rtol=1e-2, atol=0.1)
    with torch.autocast(t.device.type, torch.bfloat16):
        assert A(t.bfloat16()).dtype == torch.float32
    half = t.half().requires_grad_()
    A(half).sum().backward()
    assert half.grad.dtype == torch.float16
    with torch.no_grad():
        assert not A(torch.nn.Parameter(t)).requires_grad
    out = A(t)
    out += 1  # is the caller's own
    torch.testing.assert_close(A(t) + 1, out)


@pytest.mark.thorough
def test_within_torch_compile():
    torch = framework('torch')
    A = Projector(GEOMETRIES['cone'])
    x = array_of('torch', pair(A.domain_shape, A.range_shape)[0])
    compiled = torch.compile(lambda x: (A(x * 2) ** 2).sum(), backend='eager')
    torch.testing.assert_close(compiled(x), (A(x * 2) ** 2).sum())
    with_grad = x.clone().requires_grad_()
    compiled(with_grad).backward()
    torch.testing.assert_close(with_grad.grad, 8 * A.T(A(x)), rtol=1e-4, atol=1e-2)


def test_an_unrolled_network_learns():
    """It has steps of gradient descent whose sizes are learnt, and a small convolution between them."""
    torch = framework('torch')
    torch.manual_seed(0)
    A = Projector(GEOMETRIES['cone'])
    A2 = A.norm() ** 2

    class Unrolled(torch.nn.Module):
        def __init__(self, steps=3):
            super().__init__()
            self.size = torch.nn.Parameter(torch.ones(steps))
            self.denoise = torch.nn.Conv3d(1, 1, 3, padding=1)

        def forward(self, b):
            x = torch.zeros(b.shape[0], *A.domain_shape, device=b.device)
            for size in self.size:
                x = x - size / A2 * A.T(A(x) - b)
                x = x + self.denoise(x[:, None])[:, 0]
            return x

    truth = torch.zeros(2, *A.domain_shape, device=device())
    truth[:, 3:6, 4:8, 2:5] = 1
    net = Unrolled().to(device())
    optimiser = torch.optim.Adam(net.parameters(), 0.02)
    losses = []
    for _ in range(30):
        optimiser.zero_grad()
        loss = ((net(A(truth)) - truth) ** 2).mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]


def test_transformations_of_jax():
    jax = framework('jax')
    A = Projector(GEOMETRIES['cone'])
    x, y = (array_of('jax', v) for v in pair(A.domain_shape, A.range_shape))
    close = dict(rtol=1e-5, atol=1e-3)

    def loss(x):
        return ((A(x) - y) ** 2).sum() / 2

    np.testing.assert_allclose(jax.jit(jax.grad(loss))(x), A.T(A(x) - y), **close)
    np.testing.assert_allclose(jax.jvp(A, (x,), (2 * x,))[1], A(2 * x), **close)
    np.testing.assert_allclose(jax.jvp(jax.grad(loss), (x,), (x,))[1], A.T(A(x)), **close)
    many = jax.numpy.stack([x, 2 * x])
    np.testing.assert_allclose(jax.vmap(jax.grad(loss))(many)[1], A.T(A(2 * x) - y), **close)
    np.testing.assert_allclose(jax.linear_transpose(A, x)(y)[0], A.T(y), **close)
    np.testing.assert_allclose(jax.jit(A)(x.astype('float16')), A(x.astype('float16')), **close)


@pytest.mark.thorough
def test_norm_and_scipy():
    A = Projector(GEOMETRIES['cone'])
    op = A.aslinearoperator()
    matrix = op @ np.eye(op.shape[1], dtype=np.float32)
    largest = np.linalg.norm(matrix.astype(float), 2)
    assert A.norm() == pytest.approx(largest, rel=1e-5) == A.T.norm()
    np.testing.assert_allclose(op.H @ np.eye(op.shape[0], dtype=np.float32), matrix.T, atol=1e-5)
    x, _ = pair(A.domain_shape, A.range_shape)
    b = A(x).ravel()
    solution = lsqr(op, b, iter_lim=300)[0]
    assert np.linalg.norm(op @ solution - b) < 1e-2 * np.linalg.norm(b)
    tiny = Projector(scan(n=3, nVoxel=(2, 1, 1)))
    matrix = tiny.aslinearoperator() @ np.eye(2, dtype=np.float32)
    assert tiny.norm() == pytest.approx(np.linalg.norm(matrix, 2), rel=1e-5)
    assert Projector(GEOMETRIES['cone'], valid=np.zeros(GEOMETRIES['cone'].nDetector, bool)).norm() == 0


def test_some_views():
    g = GEOMETRIES['shaken']
    valid = np.random.default_rng(1).random((3, *g.nDetector)) < 0.7
    A = Projector(g, valid=valid)
    x, _ = pair(A.domain_shape, A.range_shape)
    for views, chosen in ((1, [1]), (-1, [2]), (slice(0, None, 2), [0, 2]), ([2, 0], [2, 0]), (np.array([1]), [1])):
        for some in (A[views], Projector(g, valid=valid, views=[views] if isinstance(views, int) else views)):
            np.testing.assert_array_equal(some(x), A(x)[chosen])
    assert len(A) == 3 and len(A[1]) == 1
    np.testing.assert_allclose(A[0].T(A(x)[:1]) + A[1:].T(A(x)[1:]), A.T(A(x)), atol=1e-3)


def test_views_one_by_one():
    A = Projector(GEOMETRIES['cone'])
    x, _ = pair(A.domain_shape, A.range_shape)
    np.testing.assert_array_equal(np.concatenate([one(x) for one in A]), A(x))
    assert A[1] is A[np.int64(1)] and A[1] is list(A)[1], 'made once'
    for other in (copy.copy(A), copy.deepcopy(A), pickle.loads(pickle.dumps(A))):
        assert other[1] is not A[1]
        np.testing.assert_array_equal(other[1](x), A[1](x))


@pytest.mark.parametrize('views', [None, slice(0, 2)])
def test_a_mask_is_a_copy(views):
    valid = np.ones((3, *GEOMETRIES['cone'].nDetector), bool)
    A = Projector(GEOMETRIES['cone'], valid=valid, views=views)
    valid[:] = False
    assert A(np.ones(A.domain_shape)).any()


def test_threads():
    A = Projector(GEOMETRIES['cone'])
    x, _ = pair((8, *A.domain_shape), A.range_shape)
    with ThreadPoolExecutor(4) as pool:
        np.testing.assert_array_equal(list(pool.map(A, x)), A(x))


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_values_that_are_not_finite(kind, value):
    A = Projector(GEOMETRIES['cone'])
    x, _ = pair(A.domain_shape, A.range_shape)
    x[1, 2, 3] = value
    with pytest.raises(InputError, match='NaN or infinity') as caught:
        A(array_of(kind, x))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('kind', ['torch', 'jax'])
@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_gradients_that_are_not_finite(kind, value):
    """They are passed on in both modes: PyTorch's GradScaler skips a step whose gradients are infinite."""
    module, A = framework(kind), Projector(GEOMETRIES['cone'])
    values = pair(A.domain_shape, A.range_shape)
    for linear_map, x in zip((A, A.T), (array_of(kind, v) for v in values)):
        if kind == 'torch':
            with_grad = x.clone().requires_grad_()
            (linear_map(with_grad) * value).sum().backward()
            gradient, along = with_grad.grad, module.func.jvp(linear_map, (x,), (x * value,))[1]
        else:
            gradient = module.grad(lambda x, linear_map=linear_map: (linear_map(x) * value).sum())(x)
            along = module.jvp(linear_map, (x,), (x * value,))[1]
        assert not np.isfinite(host(gradient)).all() and not np.isfinite(host(along)).all()


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('model', ['joseph', 'exact'])
def test_pixels_that_are_not_valid_may_be_nan(kind, model):
    """So may they in a scan. Those of valid pixels are refused."""
    g = GEOMETRIES['cone']
    valid = np.random.default_rng(1).random((3, *g.nDetector)) < 0.7
    A = Projector(g, model=model, valid=valid)
    y = np.where(valid, pair((2, *A.domain_shape), (2, *A.range_shape))[1], 0)
    expected = A.T(y)
    y[:, ~valid] = np.nan
    y[0][~valid] = np.inf
    np.testing.assert_allclose(host(A.T(array_of(kind, y))), expected, atol=1e-5 * np.abs(expected).max())
    y[1][tuple(np.argwhere(valid)[0])] = np.nan
    with pytest.raises(InputError, match='NaN or infinity'):
        A.T(array_of(kind, y))


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('shape', [(), (9,), (9, 11), (11, 9, 7), (3, 17, 21)])
def test_other_shapes(kind, shape):
    with pytest.raises(InputError, match=r'takes arrays \[\.\.\., 9, 11, 7\], not') as caught:
        Projector(GEOMETRIES['cone'])(array_of(kind, np.zeros(shape, np.float32)))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'make, message',
    [
        (lambda g: Projector(None), 'geometry must be a Geometry'),
        (lambda g: Projector(g, model='siddon'), "model is 'joseph' or 'exact', not 'siddon'"),
        (lambda g: Projector(g, views=[]), 'no views'),
        (lambda g: Projector(g)[3:], 'no views'),
        (lambda g: Projector(g)[np.zeros(3, bool)], 'no views'),
        (lambda g: Projector(g, views=[3]), 'from 0 to 2'),
        (lambda g: Projector(g)[5], 'from 0 to 2'),
        (lambda g: Projector(g)[True], 'by its number, not by True'),
        (lambda g: Projector(g, valid=np.ones((3, 4, 4), bool)), 'valid must be true or false'),
        (lambda g: Projector(g, valid=np.ones((17, 21))), 'valid must be true or false'),
        (lambda g: Projector(g)(np.ma.masked_equal(np.eye(3), 1)), 'some values are masked'),
        (lambda g: Projector(g, valid=np.ma.masked_equal(np.eye(17, 21) > 0, True)), 'some values are masked'),
        *(
            (
                lambda g, value=value: Projector(g).norm(value),
                f'tolerance must be a finite number above 0, not {value!r}',
            )
            for value in (float('nan'), float('inf'), 0, -1, 'a', True)
        ),
        (lambda g: Projector(g)('text'), 'cannot be read as an array'),
        (lambda g: Projector(g)(None), 'cannot be read as an array'),
        (lambda g: Projector(g)(np.zeros((9, 11, 7), complex)), 'not real numbers'),
        (lambda g: Projector(g)(np.broadcast_to(np.float32(0), (10**10, 9, 11, 7))), 'does not fit into memory'),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(InputError) as caught:
        make(GEOMETRIES['cone'])
    assert message in str(caught.value) and '\n' not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize('kind', KINDS)
def test_empty_batches(kind):
    A = Projector(GEOMETRIES['cone'])
    x, y = pair((2, 0, *A.domain_shape), (0, *A.range_shape))
    assert A(array_of(kind, x)).shape == (2, 0, *A.range_shape)
    assert A.T(array_of(kind, y)).shape == (0, *A.domain_shape)


def test_other_types_and_layouts():
    A = Projector(GEOMETRIES['cone'])
    x, _ = pair(A.domain_shape, A.range_shape)
    for other in (np.asfortranarray(x), x[::-1, ::-1][::-1, ::-1], x.astype(float), x.astype('>f4'), x.tolist()):
        np.testing.assert_array_equal(A(other), A(x))
    np.testing.assert_allclose(A(x.astype(np.float16)), A(x), rtol=1e-2, atol=0.1)
    np.testing.assert_array_equal(A(x > 0), A((x > 0).astype(int)))


@pytest.mark.filterwarnings('ignore:overflow')
def test_values_beyond_float32():
    with pytest.raises(InputError, match='as float32'):
        Projector(GEOMETRIES['cone'])(np.full((9, 11, 7), 1e300))


def test_the_operator_of_matrices():
    """NumPy would otherwise take A for a list of its views."""
    with pytest.raises(TypeError, match=r'support ufuncs|unsupported operand'):
        Projector(GEOMETRIES['cone']) @ np.zeros((9, 11, 7))


def arguments_of(kind):
    """Keyword arguments for a call of A: none, and rays."""
    return {}, dict(rays=array_of(kind, GEOMETRIES['cone'].rays().vectors))


@pytest.mark.filterwarnings('ignore:The PyTorch API of nested tensors')
@pytest.mark.parametrize('with_rays', [0, 1])
def test_tensors_that_are_not_dense(with_rays):
    torch, A, given = framework('torch'), Projector(GEOMETRIES['cone']), arguments_of('torch')[with_rays]
    with pytest.raises(InputError, match=r'takes dense tensors, not torch.sparse_coo: call to_dense\(\) first'):
        A(torch.zeros(9, 11, 7).to_sparse(), **given)
    for layout in (torch.strided, torch.jagged):
        with pytest.raises(InputError, match='takes dense tensors, not nested ones'):
            A(torch.nested.nested_tensor([torch.zeros(11, 7)] * 9, layout=layout), **given)
    with pytest.raises(InputError, match='not on .*meta'):
        A(torch.zeros(9, 11, 7, device='meta'), **given)


def test_a_geometry_keeps_no_derivatives():
    torch = framework('torch')
    with pytest.raises(InputError, match='angles: a geometry keeps no derivatives: detach the tensor first'):
        scan(n=3, angles=torch.zeros(3, requires_grad=True))


@pytest.mark.parametrize('with_rays', [0, 1])
@pytest.mark.parametrize('kind', ['torch', 'jax'])
def test_complex_arrays(kind, with_rays):
    zeros = array_of(kind, np.zeros((9, 11, 7), np.complex64))
    with pytest.raises(InputError, match='takes real numbers, not .*complex64'):
        Projector(GEOMETRIES['cone'])(zeros, **arguments_of(kind)[with_rays])


@pytest.mark.parametrize('with_rays', [0, 1])
def test_sparse_arrays_of_jax(with_rays):
    framework('jax')
    from jax.experimental import sparse

    zeros = sparse.BCOO.fromdense(np.zeros((9, 11, 7), np.float32))
    with pytest.raises(InputError, match='takes dense arrays, not BCOO'):
        Projector(GEOMETRIES['cone'])(zeros, **arguments_of('jax')[with_rays])


@pytest.mark.parametrize('with_rays', [0, 1])
def test_within_a_frozen_function(with_rays):
    A, x = Projector(GEOMETRIES['cone']), mi.TensorXf(np.ones((9, 11, 7), np.float32))
    given = dict(rays=mi.TensorXd(A.geometry.rays().vectors)) if with_rays else {}
    gc.collect()  # Dr.Jit's recording does not bear objects of other tests that go meanwhile
    with pytest.raises(RuntimeError) as caught:  # Dr.Jit puts its own exception around ours
        dr.freeze(lambda x, **given: A(x, **given))(x, **given)
    assert isinstance(caught.value.__cause__, InputError) and 'dr.freeze' in str(caught.value.__cause__)
    assert A(x).numpy().any()


def test_kernels_serve_any_number_of_views_and_calls():
    """After the first call nothing is compiled: not for other views, other values, nor another scan of the same size."""
    A = Projector(scan(n=4))
    x, y = pair(A.domain_shape, A.range_shape)
    A(x), A.T(y)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    other = Projector(scan(n=4, DSO=230.0))
    other(2 * x), other.T(3 * y), A[:3](x), A[[1]].T(y[1:2])
    history = dr.kernel_history()
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    kernels = [k for k in history if k['type'] == dr.KernelType.JIT]
    assert len(kernels) >= 6 and all(k['cache_hit'] or k['cache_disk'] for k in kernels)


FORKED = """
import os
import numpy as np
import lingo_mi as lm
lm.use_variant('llvm_ad_mono')
A = lm.Projector(lm.Geometry.parallel(nDetector=64, dDetector=1, nVoxel=64, dVoxel=1, angles=[0.0, 1.0]))
before = A(np.ones(A.domain_shape))
child = os.fork()
if child == 0:
    os._exit(not np.array_equal(A(np.ones(A.domain_shape)), before))
print(os.waitpid(child, 0)[1], np.array_equal(A(np.ones(A.domain_shape)), before))
"""


@pytest.mark.skipif(not hasattr(os, 'fork'), reason='there is no fork here')
def test_a_forked_process_goes_on():
    """A worker of PyTorch's DataLoader is such a process."""
    done = subprocess.run([sys.executable, '-c', FORKED], capture_output=True, text=True, timeout=120)
    assert done.stdout == '0 True\n', done


LOADED = """
import numpy as np
import torch
import lingo_mi as lm

class Projections(torch.utils.data.Dataset):
    def __init__(self, A):
        self.A = A

    def __len__(self):
        return 2

    def __getitem__(self, i):
        return self.A(torch.full(self.A.domain_shape, float(i + 1)))

if __name__ == '__main__':
    lm.use_variant('llvm_ad_mono')
    A = lm.Projector(lm.Geometry.parallel(nDetector=16, dDetector=1, nVoxel=16, dVoxel=1, angles=[0.0, 1.0]))
    wanted = A(torch.ones(A.domain_shape))
    for start in 'fork', 'spawn':
        loader = torch.utils.data.DataLoader(Projections(A), num_workers=1, multiprocessing_context=start)
        one, two = loader
        print(start, torch.equal(one[0], wanted), torch.allclose(two[0], 2 * wanted))
"""


@pytest.mark.skipif(not hasattr(os, 'fork'), reason='there is no fork here')
@pytest.mark.thorough
def test_workers_of_a_data_loader(tmp_path):
    framework('torch')
    program = tmp_path / 'loaded.py'
    program.write_text(LOADED)
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=300)
    assert done.stdout == 'fork True True\nspawn True True\n', done


def test_the_doors():
    import lingo_mi as lm

    assert lm.Projector is Projector and isinstance(GEOMETRIES['cone'], Geometry)
