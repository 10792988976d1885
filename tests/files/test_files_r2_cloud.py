"""R2-Gaussian's clouds: the numbers of its formulas, round trips, and files that hold none."""

import pickle

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.files.r2_cloud import read_r2_cloud, write_r2_cloud
from lingo_mi.geometry import Grid

GRID = Grid((10, 20, 40), 5.0, (0.0, 3.0, 0.0))  # 200 mm long: its world is 100 times smaller


def stored(**changes):
    """One Gaussian as its training stores it, turned by 90 degrees about z."""
    half = np.sqrt(0.5)
    rows = dict(
        xyz=[[0.1, -0.2, 0.3]], density=[[0.5]], scale=[[-2.0, -1.0, 0.0]], rotation=[[3 * half, 0, 0, 3 * half]]
    )
    return {k: np.array(v, np.float32) for k, v in rows.items()} | dict(scale_bound=None) | changes


def write(path, data):
    path.write_bytes(pickle.dumps(data, pickle.HIGHEST_PROTOCOL))
    return path


def test_what_a_training_stores(tmp_path):
    centres, scales, quaternions, density = read_r2_cloud(write(tmp_path / 'a.pickle', stored()), GRID)
    np.testing.assert_allclose(centres, [[10, -20, 30]], rtol=1e-6)
    np.testing.assert_allclose(scales, 100 * np.exp([[-2, -1, 0]]), rtol=1e-6)
    np.testing.assert_allclose(density, np.log(1 + np.exp(0.5)), rtol=1e-6)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternions / 3, [[0, 0, half, half]], rtol=1e-6, atol=1e-7)


def test_bounded_scales(tmp_path):
    """The stored bounds hold; by default, scales are between 0.0005 and 0.5 in a volume that is 2 long."""
    path = write(tmp_path / 'a.pickle', stored(scale_bound=np.array([0.001, 1.0])))
    expected = 100 * (0.001 + 0.999 / (1 + np.exp([[2.0, 1, 0]])))
    np.testing.assert_allclose(read_r2_cloud(path, GRID)[1], expected, rtol=1e-6)


def cloud(n=7):
    rng = np.random.default_rng(1)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    density = rng.uniform(1e-4, 2, n)
    return rng.uniform(-80, 80, (n, 3)), rng.uniform(0.5, 9, (n, 3)), q, density


def test_both_ways(tmp_path):
    gaussians = lm.Gaussians(*cloud())
    gaussians.to_r2(tmp_path / 'a.pickle', GRID)
    for a, b in zip(lm.Gaussians.from_r2(tmp_path / 'a.pickle', GRID), gaussians):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    data = pickle.loads((tmp_path / 'a.pickle').read_bytes())
    assert data['density'].shape == (7, 1) and data['density'].dtype == np.float32 and data['scale_bound'] is None
    np.testing.assert_allclose(data['rotation'][:, 0], gaussians.quaternions[:, 3], rtol=1e-6)


def test_where_its_training_starts(tmp_path):
    """Four points at the corners of a square of 0.1: the three nearest are at 0.1, 0.1 and 0.1 sqrt 2."""
    points = np.array([[0, 0, 0, 1], [0.1, 0, 0, 2], [0, 0.1, 0, 3], [0.1, 0.1, 0, 4.0]])
    np.save(tmp_path / 'init_a.npy', points)
    gaussians = lm.Gaussians.from_r2(tmp_path / 'init_a.npy', GRID)
    np.testing.assert_allclose(gaussians.means, 100 * points[:, :3], rtol=1e-6)
    np.testing.assert_allclose(gaussians.scales, 10 * np.sqrt(4 / 3), rtol=1e-6)
    assert gaussians.quaternions.tolist() == [[0, 0, 0, 1]] * 4 and gaussians.density.tolist() == [1, 2, 3, 4]
    gaussians.to_r2(tmp_path / 'b.npy', GRID)
    np.testing.assert_allclose(np.load(tmp_path / 'b.npy'), points, rtol=1e-6)


def test_the_same_volume(tmp_path):
    """A cloud that went out and in makes the same voxels."""
    gaussians = lm.Gaussians(*cloud(), extent=3.0)
    gaussians.to_r2(tmp_path / 'a.pickle', GRID)
    back = lm.voxelize(lm.Gaussians.from_r2(tmp_path / 'a.pickle', GRID), GRID)
    direct = np.asarray(lm.voxelize(gaussians, GRID))
    np.testing.assert_allclose(back, direct, atol=1e-4 * direct.max())


@pytest.mark.parametrize(
    ('data', 'match'),
    [
        ([1, 2], "has no 'xyz' \\[N, 3\\]"),
        (stored(rotation=np.zeros((1, 3), np.float32)), "has no 'rotation' \\[N, 4\\]"),
        (stored(density=np.zeros(1, np.float32)), "has no 'density' \\[N, 1\\]"),
        (stored(scale_bound=3), 'scale_bound must be two numbers or None'),
        (stored(rotation=np.zeros((1, 4), np.float32)), 'quaternion of Gaussian 0 is zero'),
        (stored(xyz=np.full((1, 3), np.nan, np.float32)), 'centres of Gaussian 0 is not finite'),
        (stored(xyz=np.zeros((2, 3), np.float32)), 'centres must have the shape'),
        (stored(scale=np.full((1, 3), 800, np.float32)), 'scales of Gaussian 0 is not finite'),
    ],
)
def test_files_that_hold_no_cloud(tmp_path, data, match):
    path = write(tmp_path / 'a.pickle', data)
    with pytest.raises(InputError, match=f'a.pickle: .*{match}'):
        read_r2_cloud(path, GRID)


def test_other_files(tmp_path):
    np.save(tmp_path / 'a.npy', np.zeros((3, 5)))
    (tmp_path / 'a.pickle').write_bytes(pickle.dumps(stored())[:-9])
    with pytest.raises(InputError, match=r'a.npy: must have the shape \[N, 4\]'):
        read_r2_cloud(tmp_path / 'a.npy', GRID)
    with pytest.raises(InputError, match='a.pickle: is truncated'):
        read_r2_cloud(tmp_path / 'a.pickle', GRID)
    with pytest.raises(
        InputError, match=r'a.ply: is not a cloud of R2-Gaussian; give its init_\*.npy or point_cloud.pickle'
    ):
        read_r2_cloud(tmp_path / 'a.ply', GRID)
    with pytest.raises(InputError, match='a.ply: clouds of R2-Gaussian are'):
        write_r2_cloud(tmp_path / 'a.ply', GRID, *cloud())
    centres, scales, quaternions, density = cloud()
    density[2] = -1
    with pytest.raises(InputError, match='no negative densities, but Gaussian 2 has one'):
        write_r2_cloud(tmp_path / 'b.pickle', GRID, centres, scales, quaternions, density)
    assert not (tmp_path / 'b.pickle').exists()


def test_gsplats_order():
    gaussians = lm.Gaussians(*cloud())
    means, quats, scales, density = gaussians.to_gsplat()
    np.testing.assert_array_equal(quats[:, 0], gaussians.quaternions[:, 3])
    again = lm.Gaussians.from_gsplat(means, quats, scales, density)
    for a, b in zip(again, gaussians):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('framework', ['torch', 'jax'])
def test_gsplats_order_in_a_framework(framework):
    numpy = pytest.importorskip('jax.numpy' if framework == 'jax' else framework)
    arrays = [numpy.asarray(array) for array in cloud()]
    quats = lm.Gaussians(*arrays).to_gsplat()[1]
    np.testing.assert_allclose(np.asarray(quats)[:, 1:], np.asarray(arrays[2])[:, :3])
