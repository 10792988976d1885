"""Work shared out among teams of any width, in any number of shares: the same images and derivatives."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from lingo_mi.projectors import balance, depth
from lingo_mi.projectors.balance import Layout, Sharing, Work
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.mesh import MeshPaths
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.projectors.view import View, vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize
from lingo_mi.validation import oracle
from lingo_mi.validation.oracle import Cloud, Pose, random_cloud, relative
from studies.hard_cases.clouds import scanner
from studies.hard_cases.measuring import on_device

# 2 lanes: a vector holds several teams, which do not end together. 32: a team is several vectors. A lane whose team is done
# must divide by nothing: an integer division by zero ends the process.
SHARINGS = {
    'narrow teams': Sharing(lanes=2),
    'wide teams': Sharing(lanes=32),
    'few shares': Sharing(shares=0.125),
    'many shares': Sharing(shares=20),
}
by_sharing = pytest.mark.parametrize('sharing', SHARINGS.values(), ids=SHARINGS)
NAMES = 'centre', 'scale', 'rotation', 'density'


def differentiated(cloud, function):
    """function(*cloud) and the derivatives of its sum with fixed weights, float64; and the weights."""
    gaussians = on_device(cloud)
    dr.enable_grad(gaussians)
    values = function(*gaussians)
    weights = np.float32(np.random.default_rng(0).normal(size=dr.width(values))).astype(float)
    dr.backward(dr.sum(values * mi.Float(weights.tolist())))
    return values.numpy(), [np.array(dr.grad(x), float).T for x in gaussians], weights


def check(actual, expected, found_gradients, expected_gradients):
    assert relative(actual, expected) < 2e-6
    for name, value in zip(NAMES, found_gradients):
        assert relative(value, expected_gradients[name]) < 1e-5, name


@by_sharing
@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_images(sharing, mode):
    frames, shape = scanner(mode)
    cloud, pose = random_cloud(np.random.default_rng(1), 12), Pose.of(frames, 0, *shape)
    view, options = View.of(frames, 0, *shape), RenderOptions(6.0, sharing=sharing)
    image, gradients, weights = differentiated(cloud, lambda *x: line_integrals(*x, view, options))
    check(image, oracle.line_integrals(cloud, pose), gradients, oracle.gradients(cloud, pose, weights))


@by_sharing
def test_voxels(sharing):
    low, step, shape = np.array([-1.0, -0.9, -0.8]), np.array([0.15, 0.26, 0.18]), (13, 7, 9)
    cloud = random_cloud(np.random.default_rng(1), 8, size=0.2)
    grid = Lattice(*map(vector64, (low, step)), shape, sharing)
    values, gradients, weights = differentiated(cloud, lambda *x: voxelize(*x, grid, 6.0))
    z, y, x = np.indices(shape[::-1])
    points = low + (np.stack([x, y, z], -1).reshape(-1, 3) + 0.5) * step
    check(values, oracle.values_at(cloud, points), gradients, oracle.value_gradients(cloud, points, weights))


@by_sharing
def test_meshes(sharing):
    """Chords of a box agree with the slabs between its faces."""
    frames, shape = scanner()
    low, high = np.array([-0.7, -0.5, -0.4]), np.array([0.6, 0.8, 0.5])
    box = trimesh.creation.box(bounds=[low, high])
    paths = MeshPaths(box.vertices, box.faces, 'box', sharing)
    actual = paths.lengths(View.of(frames, 0, *shape)).numpy()
    start, direction = Pose.of(frames, 0, *shape).rays()
    a, b = (low - start) / direction, (high - start) / direction
    inside = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    chords = np.maximum(inside[1] - inside[0], 0) * np.linalg.norm(direction, axis=1)
    assert chords.max() > 1
    np.testing.assert_allclose(actual, chords, rtol=0, atol=2e-6)


@pytest.mark.parametrize('test', [test_images, test_voxels, test_meshes])
@pytest.mark.parametrize('capability', [80, 90])
def test_layouts_of_a_gpu(capability, test, monkeypatch):
    """The lanes of a GPU's layout give the same results on any machine."""
    monkeypatch.setattr(balance, '_on_cpu', lambda: False)
    monkeypatch.setattr(balance, 'gpu', lambda: SimpleNamespace(capability=capability))
    monkeypatch.setattr(balance, 'resident_warps', lambda: 8)
    assert Sharing().adding == (balance.PAIRS if capability == 90 else balance.EIGHTS)
    test(Sharing(), *(['cone'] if test is test_images else []))


def test_parts_of_a_sum_on_a_gpu(monkeypatch):
    """A deep pile is added in several images at once, which are added up: the same image, and each part counts."""
    frames, shape = scanner('cone')
    cloud, view = random_cloud(np.random.default_rng(1), 12), View.of(frames, 0, *shape)
    many = Cloud(*(np.repeat(x, 40, 0) for x in (cloud.centre, cloud.scale, cloud.rotation, cloud.density)))
    expected = 40 * oracle.line_integrals(cloud, Pose.of(frames, 0, *shape))
    monkeypatch.setattr(balance, '_on_cpu', lambda: False)
    monkeypatch.setattr(balance, 'gpu', lambda: SimpleNamespace(capability=80))
    monkeypatch.setattr(balance, 'resident_warps', lambda: 8)
    monkeypatch.setattr(depth, 'deep', lambda: 10)
    actual = line_integrals(*on_device(many), view, RenderOptions(6.0)).numpy()
    assert relative(actual, expected) < 1e-6


def test_as_many_shares_as_asked():
    usual = Sharing().teams
    assert usual > 1 and Sharing().scaled(2).scaled(1.5).teams == 3 * usual
    assert Sharing().scaled(0.1 / usual).teams == 1


@pytest.mark.parametrize('layout', [Layout(8, 1, 4), Layout(16, 2, 4), Layout(4, 8, 1)], ids=str)
def test_packets_that_an_interval_covers(layout):
    """The interval covers all packets that hold one of its elements in the row, from the start of a step on, and none
    behind."""
    width, rng = 27, np.random.default_rng(0)
    low, column = rng.uniform(-12, 40, 500), rng.integers(-3, 4, 500)
    high, offset = low + rng.uniform(-2, 9, 500), rng.uniform(-0.5, 0.5, 500)
    arrays = [mi.Float(x.astype(np.float32)) for x in (low, high, offset)]
    packets = layout.packets(width)
    begin, end = layout.span(*arrays, mi.Int32(column), mi.Bool(np.arange(500) % 10 == 0), mi.Int32(packets))
    size, step = layout.size, layout.step
    for i, (first, last) in enumerate(zip(np.ceil(low + offset) + column, np.floor(high + offset) + column)):
        within = [e for e in range(packets * size) if first <= e <= last] if i % 10 else []
        covered = range(begin.numpy()[i], end.numpy()[i])
        if not within:
            assert len(covered) == 0
        else:
            assert covered == range(within[0] // step * layout.columns, within[-1] // size + 1)


@pytest.mark.parametrize('shares', [0.125, 1, 20])
def test_every_block_belongs_to_the_team_in_whose_share_it_begins(shares):
    """Items have no block or many, and blocks cost 1 or more. A team's share is the total over the teams, rounded up."""
    blocks, costs, sharing = [3, 0, 2, 5, 0, 1, 40], [1, 1, 2, 3, 1, 1, 1], Sharing(shares=shares)
    work = Work.of(mi.UInt32(blocks), mi.UInt32(costs), sharing)
    share = work.shares(Layout(1, 1, 4))
    first = np.concatenate([[0], np.cumsum(blocks)])
    begin, end = (first[item.numpy()] + block.numpy() for item, block in (share.begin, share.end))
    starts = np.concatenate([[0], np.cumsum(np.repeat(costs, blocks))])
    owner = starts[:-1] // (starts[-1] // sharing.teams + 1)
    assert len(begin) == sharing.teams
    for team in range(sharing.teams):
        assert list(range(begin[team], end[team])) == np.flatnonzero(owner == team).tolist()
