"""`functional.project` and `voxelize` on arrays of every kind: values and gradients against the float64 oracle, bad input."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.circles import circle
from helpers.same import adds_in_any_order, assert_same
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.functional import project, voxelize
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.upload import uploaded_tensor
from lingo_mi.validation import oracle
from lingo_mi.validation.closed_form import image_and_gradients
from lingo_mi.validation.oracle import Pose, random_cloud, relative

EXTENT = 6.0
NAMES = 'centre', 'scale', 'rotation', 'density'
KINDS = 'numpy', 'drjit', 'torch', 'jax'
DIFFERENTIABLE = KINDS[1:]
BEAMS = 'cone', 'parallel'


def scan(mode='cone', nVoxel=(11, 9, 10)):
    """Three views of a small panel, and an off-centre grid."""
    return CircularGeometry(
        DSO=500,
        DSD=750,
        nDetector=(24, 31),
        dDetector=(7, 6),
        angles=circular(3),
        mode=mode,
        grid=Grid(nVoxel, (9, 10, 8), (4, -3, 2)),
    )


def gaussians(count=9):
    return random_cloud(np.random.default_rng(1), count, spread=35, size=9)


def columns(cloud):
    return [np.float32(getattr(cloud, n)) for n in NAMES]


def framework(kind: str):
    if kind in ('torch', 'jax'):
        module = pytest.importorskip(kind, reason=f'{kind} is not installed')
        if kind == 'torch' and _device() == 'cuda' and not module.cuda.is_available():
            pytest.skip('PyTorch has no GPU')
        return module


def arrays_of(kind, values):
    """NumPy's arrays in another kind."""
    module = framework(kind)
    if kind == 'numpy':
        return list(values)
    if kind == 'drjit':
        return [mi.TensorXf(x) for x in values]
    if kind == 'torch':
        return [module.tensor(x, device=_device()) for x in values]
    return [module.numpy.asarray(x) for x in values]


def _device():
    return 'cuda' if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else 'cpu'


def host(x):
    """NumPy's values of an array of any kind, float64."""
    return np.asarray(x.detach().cpu() if hasattr(x, 'detach') else x).astype(float)


def differentiated(kind, function, values, weights):
    """function(*values), and the derivatives of sum(weights * function) by the values, in arrays of a kind."""
    arrays, (weights,) = arrays_of(kind, values), arrays_of(kind, [np.float32(weights)])
    if kind == 'jax':
        import jax

        out, pullback = jax.vjp(function, *arrays)
        return out, pullback(weights)
    if kind == 'drjit':
        dr.enable_grad(arrays)
        out = function(*arrays)
        dr.backward(dr.sum(out * weights, axis=None))
        return out, [dr.grad(x) for x in arrays]
    for x in arrays:
        x.requires_grad_()
    out = function(*arrays)
    (out * weights).sum().backward()
    return out, [x.grad for x in arrays]


def assert_derivatives(actual, expected):
    for name, derivative in zip(NAMES, actual):
        assert relative(host(derivative), expected[name]) < 1e-5, name


@pytest.fixture(scope='module', params=BEAMS)
def views(request):
    """A scan, weights of its pixels, images and derivatives by the oracle."""
    g, cloud = scan(request.param), gaussians()
    height, width = g.nDetector
    weights = np.float32(np.random.default_rng(0).normal(size=(3, height, width))).astype(float)
    poses = [Pose.of(g.rays(), i, height, width) for i in range(3)]
    images = np.array([oracle.line_integrals(cloud, pose).reshape(height, width) for pose in poses])
    parts = [oracle.gradients(cloud, pose, w.ravel()) for pose, w in zip(poses, weights)]
    return g, cloud, weights, images, {n: sum(part[n] for part in parts) for n in NAMES}


@pytest.mark.parametrize('kind', KINDS)
def test_images(kind, views):
    g, cloud, _, expected, _ = views
    arrays = arrays_of(kind, columns(cloud))
    image = project(*arrays, g, extent=EXTENT)
    assert type(image) is {'numpy': np.ndarray, 'drjit': mi.TensorXf}.get(kind, type(arrays[0]))
    assert str(image.dtype).endswith('float32') if kind != 'drjit' else True
    assert relative(host(image), expected) < 2e-6
    some = project(*arrays, g, extent=EXTENT, views=[2, -3])
    assert_same(host(some), host(image)[[2, 0]])


@pytest.mark.parametrize('kind', DIFFERENTIABLE)
def test_derivatives_of_images(kind, views):
    g, cloud, weights, expected, derivatives = views
    out, actual = differentiated(kind, lambda *x: project(*x, g, extent=EXTENT), columns(cloud), weights)
    assert relative(host(out), expected) < 2e-6
    assert_derivatives(actual, derivatives)


def test_the_closed_form_agrees():
    """It is the float64 form of the published errors, for one view alone."""
    g, cloud = scan(), gaussians()
    weights = np.random.default_rng(3).normal(size=g.nDetector)
    image, expected = image_and_gradients([getattr(cloud, n) for n in NAMES], g.rays()[[1]], g.nDetector, weights)
    out, actual = differentiated(
        'drjit', lambda *x: project(*x, g, extent=EXTENT, views=[1]), columns(cloud), weights[None]
    )
    assert relative(host(out), image) < 2e-6
    assert_derivatives(actual, expected)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('nVoxel', [(11, 9, 10), (6, 1, 13)])
def test_voxels(kind, nVoxel):
    g, cloud = scan(nVoxel=nVoxel), gaussians()
    axes = [o + d * (np.arange(n) - (n - 1) / 2) for o, d, n in zip(g.grid.centre, g.grid.spacing, nVoxel)]
    points = np.stack(np.meshgrid(*axes, indexing='ij'), -1).reshape(-1, 3)
    weights = np.float32(np.random.default_rng(0).normal(size=nVoxel)).astype(float)

    def grid(*arrays):
        return voxelize(*arrays, g, extent=EXTENT)

    if kind == 'numpy':
        out = grid(*columns(cloud))
    else:
        out, actual = differentiated(kind, grid, columns(cloud), weights)
        assert_derivatives(actual, oracle.value_gradients(cloud, points, weights.ravel()))
    assert tuple(out.shape) == nVoxel
    assert relative(host(out), oracle.values_at(cloud, points)) < 2e-6


def test_dr_jit_vectors(views):
    """Point3f, Vector3f, Vector4f and Float give what tensors give, in forward mode, too."""
    g, cloud, weights, expected, derivatives = views
    types = mi.Point3f, mi.Vector3f, mi.Vector4f, mi.Float
    arrays = [Type(x.T.copy()) for Type, x in zip(types, columns(cloud))]
    dr.enable_grad(arrays)
    images = project(*arrays, g, extent=EXTENT)
    assert relative(images.numpy(), expected) < 2e-6
    dr.forward(arrays[3])  # the image of densities that all grow by 1
    along = (weights * dr.grad(images).numpy()).sum()
    assert abs(along - derivatives['density'].sum()) < 1e-5 * np.abs(derivatives['density']).sum()


def test_literals():
    """Arrays may repeat one number, which Dr.Jit does not store."""
    equal = [mi.TensorXf(x) for x in (np.zeros((5, 3)), np.full((5, 3), 9), np.tile([0, 0, 0, 1], (5, 1)))]
    image = project(*equal, dr.full(mi.TensorXf, 0.2, 5), scan())
    one = project(np.zeros((1, 3)), np.full((1, 3), 9), [[0, 0, 0, 1]], [1.0], scan())
    np.testing.assert_allclose(image.numpy(), one, rtol=1e-5)


def test_a_virtual_panel_at_the_axis():
    """The same rays, through pixels two thirds as large, meet the same Gaussians, also those behind the axis."""
    far = scan()
    virtual = replace(far, DSD=500, dDetector=(7 / 1.5, 4.0))
    values = columns(gaussians())
    np.testing.assert_allclose(project(*values, virtual), project(*values, far), rtol=1e-5, atol=1e-6)


def test_anything_that_numpy_reads():
    """These are lists, whole numbers, float64, arrays of another order of memory, and objects with __dlpack__ alone."""

    class Foreign:
        def __init__(self, values):
            self.values = values

        def __dlpack__(self, **options):
            return self.values.__dlpack__(**options)

        def __dlpack_device__(self):
            return self.values.__dlpack_device__()

    g, values = scan(), columns(gaussians())
    expected = project(*values, g)
    for convert in (np.ndarray.tolist, np.float64, np.asfortranarray, Foreign):
        assert_same(project(*map(convert, values), g), expected)
    whole = [[0, 1, 2]], [[9, 8, 7]], [[0, 0, 0, 2]], [1]
    assert_same(project(*whole, g), project(*map(np.float32, whole), g))


@pytest.mark.parametrize('kind', ['torch', 'jax'])
def test_float64(kind):
    """Float64 is computed in float32; PyTorch's derivatives are float64 again."""
    module, g, values = framework(kind), scan(), columns(gaussians())
    expected = project(*values, g)
    if kind == 'jax':
        with module.enable_x64(True):
            arrays = [module.numpy.asarray(x, dtype='float64') for x in values]
            assert arrays[0].dtype == 'float64'
            image = project(*arrays, g)
            slopes = module.grad(lambda m: project(m, *arrays[1:], g).sum())(arrays[0])
    else:
        arrays = [module.tensor(x, dtype=module.float64, device=_device(), requires_grad=True) for x in values]
        image = project(*arrays, g)
        image.sum().backward()
        slopes = arrays[0].grad
    assert str(image.dtype).endswith('float32') and str(slopes.dtype).endswith('float64')
    np.testing.assert_allclose(host(image), expected, rtol=1e-5, atol=1e-6)


def test_torch_parameters_and_no_grad():
    torch = framework('torch')
    g, values = scan(), columns(gaussians())
    parameters = [torch.nn.Parameter(x) for x in arrays_of('torch', values)]
    out = project(*parameters, g)
    out.sum().backward()  # of one value repeated
    assert all(p.grad.shape == p.shape and p.grad.abs().max() > 0 for p in parameters)
    with torch.no_grad():
        without = project(*parameters, g)
    assert out.requires_grad and not without.requires_grad
    assert_same(host(out), host(without))
    strided = [torch.stack([p.detach(), p.detach()], -1)[..., 0] for p in parameters]
    assert_same(host(project(*strided, g)), host(without))


def test_a_constant_in_torch():
    """Derivatives may be by some of the four arrays alone."""
    framework('torch')
    arrays = arrays_of('torch', columns(gaussians()))
    arrays[3].requires_grad_()
    project(*arrays, scan(), views=[0]).sum().backward()
    assert arrays[3].grad.min() > 0 and arrays[0].grad is None


def test_within_a_jitted_function_of_jax():
    jax = framework('jax')
    g, arrays = scan(), arrays_of('jax', columns(gaussians()))

    def loss(*x):
        return (project(*x, g, views=[0, 1]) ** 2).sum() + voxelize(*x, g).sum()

    expected = jax.value_and_grad(loss, argnums=(0, 1, 2, 3))(*arrays)
    actual = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2, 3)))(*arrays)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected)):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6 * (np.abs(b).max() if adds_in_any_order() else 1))


@pytest.mark.thorough
def test_a_training_loop_in_torch():
    """Twelve Gaussians are fitted to 8 views of as many, two views a step, and the volume ends within a tenth of the true
    one."""
    torch = framework('torch')
    g = CircularGeometry(DSO=500, DSD=750, nDetector=(32, 32), dDetector=6, angles=circular(8), grid=Grid((16,) * 3, 8))
    rng, truth = np.random.default_rng(5), columns(random_cloud(np.random.default_rng(4), 12, spread=30, size=10))
    measured = torch.tensor(project(*truth, g, extent=8.0), device=_device())
    grid = voxelize(*truth, g, extent=8.0)

    def parameter(values):
        return torch.nn.Parameter(torch.tensor(values, dtype=torch.float32, device=_device()))

    means = parameter(truth[0] + rng.normal(0, 4, (12, 3)))
    log_scales = parameter(np.full((12, 3), np.log(12.0)))
    quaternions = parameter(np.tile([0.0, 0, 0, 1], (12, 1)))
    log_density = parameter(np.full(12, np.log(0.5)))
    rates = (means, 0.6), (log_scales, 0.03), (quaternions, 0.03), (log_density, 0.03)
    optimiser = torch.optim.Adam([dict(params=[p], lr=rate) for p, rate in rates])

    def error():
        volume = voxelize(*(x.detach() for x in cloud()), g)
        return relative(host(volume), grid)

    def cloud():
        return means, log_scales.exp(), quaternions, log_density.exp()

    before = error()
    for step in range(200):
        views = [step % 8, (step + 3) % 8]
        loss = (project(*cloud(), g, views=views) - measured[views]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert before > 0.4 and error() < 0.1


def test_nothing_is_compiled_anew():
    """Other views and other numbers of Gaussians run the kernels of the first."""
    values = columns(gaussians(12))

    def run(count, views):
        def both():
            arrays = [uploaded_tensor(x[:count]) for x in values]  # how the caller's lie in memory would be compiled in
            dr.enable_grad(arrays)
            images = project(*arrays, scan(), views=views)
            dr.backward(dr.sum(images * images, axis=None))
            dr.eval([dr.grad(x) for x in arrays])
            project(*(x[:count] for x in values), scan(), views=views)
            voxelize(*(x[:count] for x in values), scan())

        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            both()
            dr.sync_thread()
            return {k['hash'] for k in dr.kernel_history((dr.KernelType.JIT,))}

    kernels = run(12, [0]) | run(12, [0])  # what is recorded is traced a little differently from what is replayed
    assert run(12, [1]) <= kernels and run(9, [2]) <= kernels and run(9, [0]) <= kernels


GOOD = [np.zeros((4, 3)), np.ones((4, 3)), np.tile([0.0, 0, 0, 1], (4, 1)), np.ones(4)]
NAN = np.where(np.arange(12).reshape(4, 3) == 7, np.nan, 0.0)
BAD = {
    'two components': ([GOOD[0][:, :2], *GOOD[1:]], r'means must be of the shape \[N, 3\], not \[4, 2\]'),
    'transposed': ([GOOD[0].T, *GOOD[1:]], r'means must be of the shape \[N, 3\], not \[3, 4\]'),
    'one scale a Gaussian': ([GOOD[0], np.ones(4), *GOOD[2:]], r'scales must be of the shape \[4, 3\], not \[4\]'),
    'fewer quaternions': (
        [*GOOD[:2], GOOD[2][:3], GOOD[3]],
        r'quaternions must be of the shape \[4, 4\], not \[3, 4\]',
    ),
    'a column of densities': ([*GOOD[:3], np.ones((4, 1))], r'density must be of the shape \[4\], not \[4, 1\]'),
    'three densities': (
        [*(x[:1] for x in GOOD[:3]), np.ones((1, 3))],
        r'density must be of the shape \[1\], not \[1, 3\]',
    ),
    'no axis': ([np.float32(1), *GOOD[1:]], r'means must be of the shape \[N, 3\], not \[\]'),
    'empty': ([x[:0] for x in GOOD], 'the cloud is empty'),
    'NaN': ([NAN, *GOOD[1:]], 'Gaussian 2 of the arrays given to'),
    'infinite density': ([*GOOD[:3], np.array([1, 1, 1, np.inf])], 'Gaussian 3 of the arrays'),
    'scale of zero': ([GOOD[0], GOOD[1] * [1, 0, 1], *GOOD[2:]], 'the scales positive'),
    'negative scale': ([GOOD[0], -GOOD[1], *GOOD[2:]], 'the scales positive'),
    'quaternion of zero': ([*GOOD[:2], 0 * GOOD[2], GOOD[3]], 'the quaternion not zero'),
}


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('name', BAD)
@pytest.mark.parametrize('function', [project, voxelize])
def test_bad_arrays(function, name, kind):
    values, message = BAD[name]
    arrays = arrays_of(kind, map(np.float32, values))
    with pytest.raises(InputError, match=message) as caught:
        function(*arrays, scan())
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'views, message',
    [
        ([], 'at least one'),
        ([3], 'from -3 to 2'),
        ([-4], 'from -3 to 2'),
        ([0.5], 'whole'),
        ('ab', 'whole'),
        (7, 'whole'),
    ],
)
def test_bad_views(views, message):
    with pytest.raises(InputError, match=message):
        project(*GOOD, scan(), views=views)


@pytest.mark.parametrize('extent', [0.5, 21, np.nan])
def test_bad_extent(extent):
    for function in (project, voxelize):
        with pytest.raises(InputError, match='extent is in standard deviations'):
            function(*GOOD, scan(), extent=extent)


@pytest.mark.parametrize('count', [100_000, 1_000_000])
def test_results_larger_than_memory(count):
    huge = dict(nDetector=count, nVoxel=count, dDetector=1e-6, dVoxel=1e-6)
    geometry = circle(DSO=5, DSD=7, angles=[0.0, 1.0], **huge)
    for function in (project, voxelize):
        with pytest.raises(InputError, match='do not fit into this process'):
            function(*GOOD, geometry)


@pytest.mark.parametrize(
    'values', [None, 'abc', [['a', 'b', 'c']] * 4, [['1', '2', '3']] * 4, [[1j, 2, 3]] * 4, [[1, 2], [3]]]
)
def test_what_is_no_array(values):
    with pytest.raises(InputError, match='means'):
        project(values, *GOOD[1:], scan())


@pytest.mark.parametrize('function', [project, voxelize])
@pytest.mark.parametrize('kind', ['torch', 'jax'])
def test_complex_numbers(function, kind):
    arrays = arrays_of(kind, map(np.complex64, GOOD))
    with pytest.raises(InputError, match=f'{function.__name__} takes real numbers, not .*complex64'):
        function(*arrays, scan())


def test_sparse_tensors():
    framework('torch')
    arrays = [x.to_sparse() for x in arrays_of('torch', map(np.float32, GOOD))]
    with pytest.raises(InputError, match='project takes dense tensors, not torch.sparse_coo'):
        project(*arrays, scan())


def test_several_kinds_at_once():
    with pytest.raises(InputError, match='of one kind, not means of Dr.Jit, scales of NumPy'):
        project(mi.TensorXf(GOOD[0]), *GOOD[1:], scan())


def test_torch_devices():
    torch = framework('torch')
    arrays = [torch.tensor(x, dtype=torch.float32) for x in GOOD]
    with pytest.raises(InputError, match='the CPU or on one CUDA device, not on .*meta'):
        project(*(x.to('meta') for x in arrays), scan())
    if _device() == 'cuda':
        with pytest.raises(InputError, match="on the device 'cpu', but the variant cuda"):
            project(*arrays, scan())


@pytest.mark.parametrize('kind', KINDS[:1] + KINDS[2:])
def test_a_fresh_process(kind):
    """The variant is chosen on first use, and a framework that the caller has not imported is not imported."""
    framework(kind)
    make = dict(numpy='numpy.asarray', torch='torch.tensor', jax='jax.numpy.asarray')[kind]
    program = f"""
import sys, {make.partition('.')[0]}
from lingo_mi.functional import project, voxelize
from lingo_mi.geometry import Geometry, Grid, circular
cloud = [{make}(x) for x in ([[0.0, 1.0, 2.0]], [[9.0, 8.0, 7.0]], [[0.0, 0.0, 0.0, 1.0]], [0.5])]
geometry = Geometry.cone(
    DSO=500, DSD=750, nDetector=(8, 9), dDetector=20, grid=Grid((4, 5, 6), 20), angles=circular(2)
)
print(project(*cloud, geometry).shape, voxelize(*cloud, geometry).shape, *sorted({{'torch', 'jax'}} & set(sys.modules)))
"""
    process = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    shapes = 'torch.Size([2, 8, 9]) torch.Size([4, 5, 6])' if kind == 'torch' else '(2, 8, 9) (4, 5, 6)'
    assert process.stdout.split('\n')[0] == shapes + ('' if kind == 'numpy' else f' {kind}')


def test_twice_through_one_graph_of_torch():
    torch = framework('torch')
    arrays = arrays_of('torch', columns(gaussians()))
    arrays[3].requires_grad_()
    images = project(*arrays, scan(), views=[0, 1])
    loss, other = images.sum(), (images[0] ** 2).sum()
    (first,) = torch.autograd.grad(loss, arrays[3], retain_graph=True)
    (of_other,) = torch.autograd.grad(other, arrays[3], retain_graph=True)
    (again,) = torch.autograd.grad(loss, arrays[3])
    assert_same(host(first), host(again))
    (alone,) = torch.autograd.grad((project(*arrays, scan(), views=[0, 1])[0] ** 2).sum(), arrays[3])
    assert_same(host(of_other), host(alone))
    assert np.abs(host(of_other) - host(first)).max() > 0.1 * np.abs(host(first)).max()
    with pytest.raises(RuntimeError, match='second time'):
        torch.autograd.grad(images.mean(), arrays[3])


def test_back_through_graphs_in_another_thread():
    """PyTorch does so on a GPU, in one thread for all graphs."""
    framework('torch')
    with ThreadPoolExecutor(1) as pool:
        for function in (project, voxelize) * 2:
            arrays, others = (arrays_of('torch', columns(gaussians())) for _ in range(2))
            for x in (*arrays, *others):
                x.requires_grad_()
            pool.submit(function(*arrays, scan()).square().sum().backward).result()
            function(*others, scan()).square().sum().backward()
            for x, other in zip(arrays, others):
                assert relative(host(x.grad), host(other.grad)) < 1e-5


def test_jacobian_of_torch():
    torch = framework('torch')
    arrays = arrays_of('torch', columns(gaussians()))

    def pixels(density):
        return project(*arrays[:3], density, scan(), views=[0])[0, :2, :2].ravel()

    jacobian = torch.autograd.functional.jacobian(pixels, arrays[3])
    for i, row in enumerate(jacobian):
        density = arrays[3].clone().requires_grad_()
        pixels(density)[i].backward()
        assert_same(host(row), host(density.grad))


@pytest.mark.parametrize('kind', ['numpy', 'torch', 'jax'])
def test_calls_from_several_threads(kind):
    arrays = arrays_of(kind, columns(gaussians()))
    expected = host(project(*arrays, scan(), views=[0]))
    with ThreadPoolExecutor(4) as pool:
        for actual in pool.map(lambda _: project(*arrays, scan(), views=[0]), range(12)):
            assert_same(host(actual), expected)


def test_variant(variant):
    """An active variant stays, unless the arrays lie elsewhere."""
    here, there = ('cuda', 'cpu') if variant.startswith('cuda') else ('cpu', 'cuda')
    assert ensure_variant() == ensure_variant(here) == variant == mi.variant()
    with pytest.raises(InputError, match=f'on the device {there!r}, but the variant {variant} works on {here!r}'):
        ensure_variant(there)
