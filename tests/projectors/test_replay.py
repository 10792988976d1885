"""Replayed calls: the numbers of traced ones, whatever changes between them, and no kernel compiled anew."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.same import assert_same
from lingo_mi.common.errors import InputError
from lingo_mi.projectors import replay
from lingo_mi.projectors.cloud import columns, line_integrals, line_integrals_of_rows
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.replay import Replay
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View, vector64

SIDE = 24


def view(turn=0.0, side=SIDE, parallel=False):
    c, s = np.cos(turn), np.sin(turn)
    u, v = np.array([-s, c, 0]) * 5 / side, np.array([0, 0, 5 / side])
    corner = -np.array([c, s, 0]) * 4 - (u + v) * side / 2
    return View(*map(vector64, (np.array([c, s, 0]) * (1 if parallel else 8), corner, u, v)), side, side, parallel)


def cloud(n, seed=0):
    rng = np.random.default_rng(seed)
    columns = (
        rng.uniform(-1, 1, (n, 3)),
        rng.uniform(0.05, 0.3, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.1, 1, n),
    )
    centre, scale, rotation, density = ([uploaded(x) for x in np.atleast_2d(c.T)] for c in columns)
    return mi.Point3f(centre), mi.Vector3f(scale), mi.Vector4f(rotation), *density


def image_and_gradients(gaussians, rays, wanted, frozen, weight=None, primal=True, **options):
    """The image and the derivatives by the wanted inputs, evaluated."""
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, frozen):
        inputs = *(dr.detach(x) for x in gaussians), *(dr.detach(x) for x in (rays.source, rays.corner, rays.u, rays.v))
        leaves = [inputs[i] for i in wanted]
        dr.enable_grad(leaves)
        rays = View(*inputs[4:], rays.width, rays.height, rays.parallel)
        image = line_integrals(*inputs[:4], rays, RenderOptions(**{'extent': 4.0, **options}), primal)
        weights = mi.Float(np.random.default_rng(1).normal(size=dr.width(image)).astype(np.float32))
        dr.backward(image * (weights if weight is None else weight))
        gradient = [dr.detach(image), *(dr.grad(x) for x in leaves)]
        dr.eval(gradient)
        return gradient


CLOUD, ALL = (0, 1, 2, 3), tuple(range(8))


def calls():
    return {  # each after the others, which a recording could be taken from
        'a cloud': (cloud(200), view(), CLOUD, {}),
        'other numbers': (cloud(200, 1), view(), CLOUD, {}),
        'more Gaussians': (cloud(300), view(), CLOUD, {}),
        'as many as pixels': (cloud(SIDE * SIDE), view(), CLOUD, {}),
        'one': (cloud(1), view(), CLOUD, {}),
        'another view': (cloud(200), view(1.0), CLOUD, {}),
        'more pixels': (cloud(200), view(side=32), CLOUD, {}),
        'parallel': (cloud(200), view(parallel=True), CLOUD, {}),
        'another cut-off': (cloud(200), view(), CLOUD, dict(extent=3.0)),
        'affine': (cloud(200), view(), CLOUD, dict(footprint='affine')),
        'area': (cloud(200), view(), CLOUD, dict(area=True)),
        'by the density alone': (cloud(200), view(), (3,), {}),
        'by the pose, too': (cloud(200), view(), ALL, {}),
        'by the pose alone': (cloud(200), view(), (4, 5, 6, 7), {}),
        'a density for all': ((*cloud(200)[:3], mi.Float(0.5)), view(), CLOUD, {}),
        'another density for all': ((*cloud(200)[:3], mi.Float(0.25)), view(), CLOUD, {}),
        'round': ((cloud(200)[0], mi.Vector3f(cloud(200)[1].x), *cloud(200)[2:]), view(), CLOUD, {}),
        'a pile': (tuple(type(x)(dr.repeat(x, 3000)) for x in cloud(1)), view(), CLOUD, {}),
        'equal weights': (cloud(200), view(), CLOUD, dict(weight=2.0)),
        'other equal weights': (cloud(200), view(), CLOUD, dict(weight=3.0)),
    }


@pytest.fixture(scope='module')
def traced():
    return {name: image_and_gradients(*call[:3], False, **call[3]) for name, call in calls().items()}


@pytest.mark.parametrize('again', (False, True), ids=('recorded', 'replayed'))
def test_equal_to_traced_calls(traced, again):
    for name, call in calls().items():
        for actual, expected in zip(image_and_gradients(*call[:3], True, **call[3]), traced[name], strict=True):
            assert_same(actual, expected)
            assert np.abs(np.array(actual)).max() > 0, name


def test_compiles_nothing_anew():
    """This holds whatever the number of Gaussians, and however a call is made."""
    image_and_gradients(cloud(150), view(), CLOUD, True)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for n in (150, 151, 700, 150):
            image_and_gradients(cloud(n), view(0.3), CLOUD, True)
        history = dr.kernel_history()
    fresh = [k['hash'] for k in history if k['type'] == dr.KernelType.JIT and (not k['cache_hit'] or k['cache_disk'])]
    assert len(history) > 40 and not fresh


def test_from_rows():
    """Rows give the values of columns to the last bit; `lingo_xray` passes rows."""
    rows = uploaded(np.concatenate([np.array(x) for x in cloud(200)[:3]]).T.ravel())
    upstream, actual = uploaded(np.random.default_rng(2).normal(size=SIDE**2)), []
    for by_rows in (False, True, True):
        dr.disable_grad(rows)
        dr.enable_grad(rows)
        density, options = cloud(200)[3], RenderOptions(4.0)
        if by_rows:
            image = line_integrals_of_rows(rows, density, view(), options)
        else:
            image = line_integrals(*columns(rows), density, view(), options)
        dr.backward(image * upstream)
        actual.append((image.numpy(), dr.grad(rows).numpy()))
    for other in actual[1:]:
        for a, b in zip(actual[0], other, strict=True):
            assert_same(a, b)
    assert all(np.abs(x).max() > 0 for x in actual[0])


def test_derivatives_alone():
    """They are the same without the image, as `mi.render` asks for them in its backward pass."""
    gaussians = cloud(200)
    with_image, without = (
        image_and_gradients(gaussians, view(), CLOUD, True, primal=primal) for primal in (True, False)
    )
    assert not np.any(np.array(without[0])) and np.any(np.array(with_image[0]))
    assert all(np.array_equal(np.array(a), np.array(b)) for a, b in zip(with_image[1:], without[1:], strict=True))


def test_an_empty_cloud_is_refused():
    with pytest.raises(InputError, match='at least one Gaussian'):
        line_integrals(mi.Point3f(), mi.Vector3f(), mi.Vector4f(), mi.Float(), view(), RenderOptions())


def test_exceptions_are_those_of_the_function():
    def refuse(x):
        raise InputError('no')

    with pytest.raises(InputError, match='no'):
        Replay(refuse)(mi.Float(1, 2))


def test_recordings_are_few():
    doubled = Replay(lambda x: 2 * x)
    for n in range(1, 2 * replay.MOST):
        assert np.array_equal(doubled(dr.arange(mi.Float, n)), 2.0 * np.arange(n))
    assert len(doubled.recordings) == replay.MOST


def test_settings_are_no_constants():
    scaled = Replay(lambda x, factor: factor * x)
    for factor in (2.0, 3.0, 2.0):
        assert scaled(mi.Float(1, 2), factor=factor).numpy().tolist() == [factor, 2 * factor]


def test_collects_no_garbage_while_recording():
    """A Mitsuba scene that is collected then would abort the process."""
    collecting = []
    noted = Replay(lambda x: collecting.append(gc.isenabled()) or 2 * x)
    noted(mi.Float(1, 2))
    assert collecting == [False] and gc.isenabled()
