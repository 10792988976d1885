"""The voxel projector against closed forms, float64 quadrature, its own transpose, and the conventions."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from helpers.grids import backproject, scan
from lingo_mi.common.errors import InputError
from lingo_mi.projectors.grid import Lines, line_integrals, project_volume, view_rays, view_table


def interpolate(volume, box_min, voxel, points):
    """The trilinear interpolant in float64, one axis at a time: edge values held, zero outside the box."""
    g = (points - box_min) / voxel
    outside = ((g < 0) | (g > volume.shape)).any(-1)
    value = 0
    cells, fractions = [], []
    for axis in range(3):
        q = np.clip(g[..., axis] - 0.5, 0, volume.shape[axis] - 1)
        low = np.minimum(np.floor(q).astype(int), max(volume.shape[axis] - 2, 0))
        cells.append((low, np.minimum(low + 1, volume.shape[axis] - 1)))
        fractions.append((1 - (q - low), q - low))
    for i in range(2):
        for j in range(2):
            for k in range(2):
                weight = fractions[0][i] * fractions[1][j] * fractions[2][k]
                value = value + weight * volume[cells[0][i], cells[1][j], cells[2][k]]
    return np.where(outside, 0, value)


def quadrature(volume, box_min, voxel, origin, direction, n=40001):
    """Line integrals by the midpoint rule inside the box, float64, one ray at a time."""
    box_max = box_min + voxel * np.array(volume.shape)
    out = []
    for o, d in zip(origin, direction):
        with np.errstate(divide='ignore'):
            a, b = (box_min - o) / d, (box_max - o) / d
        t0, t1 = np.minimum(a, b).max(), np.maximum(a, b).min()
        if not t0 < t1:
            out.append(0.0)
            continue
        t = t0 + (np.arange(n) + 0.5) / n * (t1 - t0)
        mean = interpolate(volume, box_min, voxel, o + t[:, None] * d).mean()
        out.append(mean * (t1 - t0) * np.linalg.norm(d))
    return np.array(out)


def rays(rng, n, box_min, box_max):
    centre, size = (box_min + box_max) / 2, (box_max - box_min).max()
    direction = rng.normal(size=(n, 3)) * rng.uniform(0.1, 10, (n, 1))
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return centre + rng.uniform(-0.4, 0.4, (n, 3)) * (box_max - box_min) - 2 * size * unit, direction


def integrate(volume, box_min, box_max, origin, direction, **ends):
    data = mi.Float(np.ascontiguousarray(volume, np.float32).ravel())
    return line_integrals(
        data,
        volume.shape,
        box_min,
        box_max,
        Lines(mi.Point3f(np.asarray(origin, np.float32).T), mi.Vector3f(np.asarray(direction, np.float32).T), **ends),
    ).numpy()


@pytest.mark.parametrize('shape', [(6, 5, 4), (1, 8, 3), (7, 6, 1), (1, 1, 1)])
def test_against_quadrature(shape):
    rng = np.random.default_rng(3)
    volume, box_min, voxel = rng.random(shape), np.array([-3.0, 2.0, -1.0]), np.array([0.7, 1.1, 0.9])
    box_max = box_min + voxel * shape
    origin, direction = rays(rng, 40, box_min, box_max)
    expected = quadrature(volume, box_min, voxel, origin, direction)
    assert np.count_nonzero(expected) > 30
    result = integrate(volume, box_min, box_max, origin, direction)
    np.testing.assert_allclose(result, expected, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize('axis', [0, 1, 2])
@pytest.mark.parametrize('sign', [-1, 1])
def test_rays_along_an_axis_on_and_between_grid_planes(axis, sign):
    rng = np.random.default_rng(1)
    volume = rng.random((4, 5, 6))
    origin = rng.integers(0, 7, (12, 3)) / 2.0  # half steps: voxel centres, faces and edges alike
    origin = np.minimum(np.maximum(origin, 0.25), np.array(volume.shape) - 0.25)
    origin[:, axis] = -sign * 50
    direction = np.zeros((12, 3))
    direction[:, axis] = sign
    box_max = np.array(volume.shape, float)
    expected = quadrature(volume, np.zeros(3), np.ones(3), origin, direction + 1e-12)
    np.testing.assert_allclose(integrate(volume, [0, 0, 0], box_max, origin, direction), expected, rtol=1e-4)


def test_constant_cube_gives_the_chord():
    rng = np.random.default_rng(0)
    box_min, box_max = np.array([-1.0, -2, -3]), np.array([2.0, 2, 1])
    origin, direction = rays(rng, 200, box_min, box_max)
    a, b = (box_min - origin) / direction, (box_max - origin) / direction
    chord = np.maximum(np.maximum(a, b).min(1) - np.minimum(a, b).max(1), 0)
    chord *= np.linalg.norm(direction, axis=1)
    result = integrate(np.full((5, 8, 3), 2.0), box_min, box_max, origin, direction)
    np.testing.assert_allclose(result, 2 * chord, rtol=1e-5, atol=1e-5)


def test_linear_ramp_between_the_outer_centres():
    """With x at voxel centres, the integral over [1/2, n - 1/2] along x is the mean times the length."""
    n = 8
    volume = np.broadcast_to(np.arange(n)[:, None, None] + 0.5, (n, 3, 3))
    direction = np.array([[1.0, 0.05, 0.02]])
    origin = np.array([[0.5, 1.2, 1.4]])
    result = integrate(volume, [0, 0, 0], [n, 3, 3], origin, direction, t_min=0.0, t_max=float(n - 1))
    np.testing.assert_allclose(result, (n - 1) * n / 2 * np.linalg.norm(direction), rtol=1e-6)


def test_rays_start_and_end():
    volume = np.ones((4, 4, 4))
    ends = integrate(volume, [0, 0, 0], [4, 4, 4], [[2.0, 2, 2]], [[0, 0, 2.0]], t_min=0.0, t_max=0.5)
    np.testing.assert_allclose(ends, 1.0, rtol=1e-6)
    assert integrate(volume, [0, 0, 0], [4, 4, 4], [[2.0, 2, 9]], [[0, 0, 1.0]], t_min=0.0) == 0


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_project_against_quadrature(mode):
    geometry = scan(mode)
    volume = np.random.default_rng(2).random(geometry.grid.shape)
    frames, result = geometry.rays(), project_volume(volume, geometry)
    assert result.shape == (4, 17, 21) and result.dtype == np.float32
    box_min = np.array(geometry.grid.centre) - np.array(geometry.grid.size) / 2
    for view, row, column in [(0, 8, 10), (1, 4, 7), (2, 11, 15), (3, 7, 3)]:
        o, d = frames.through(view, column + 0.5, row + 0.5)
        expected = quadrature(volume, box_min, np.array(geometry.grid.spacing), [o], [d])
        np.testing.assert_allclose(result[view, row, column], expected[0], rtol=2e-5)
    assert np.count_nonzero(result) > 100


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('shape', [(9, 11, 7), (9, 11, 1)])
def test_backproject_is_the_transpose(mode, shape):
    geometry = scan(mode, nVoxel=shape)
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=shape), rng.normal(size=(4, 17, 21))
    ax, aty = project_volume(x, geometry).astype(float), backproject(y, geometry).astype(float)
    assert abs(np.vdot(ax, y) - np.vdot(x, aty)) < 1e-5 * np.linalg.norm(ax) * np.linalg.norm(y)


def test_empty_margins_change_nothing():
    geometry = scan(nVoxel=(12, 13, 11), dVoxel=(3.0, 3.0, 3.0))
    volume = np.zeros(geometry.grid.shape)
    volume[4:7, 5:6, 8:11] = np.random.default_rng(0).random((3, 1, 3)) + 1
    whole = volume + 1e-30  # nothing is empty, nothing is clipped
    np.testing.assert_allclose(project_volume(volume, geometry), project_volume(whole, geometry), rtol=1e-5, atol=1e-5)
    assert not project_volume(np.zeros(geometry.grid.shape), geometry).any()


def test_derivatives_in_both_modes():
    geometry = scan(n=1)
    rng = np.random.default_rng(7)
    x, dx = rng.random(geometry.grid.shape), rng.normal(size=geometry.grid.shape)
    origin, direction, t_min = view_rays(mi.Float(view_table(geometry)[0]), *geometry.nDetector)
    half = np.array(geometry.grid.size) / 2
    weight = rng.normal(size=geometry.nDetector)

    def run(data):
        return line_integrals(data, geometry.grid.shape, -half, half, Lines(origin, direction, t_min))

    data = mi.Float(np.float32(x).ravel())
    dr.enable_grad(data)
    dr.backward(dr.sum(run(data) * mi.Float(np.float32(weight.T).ravel())))
    expected = backproject(weight[None], geometry)
    np.testing.assert_allclose(data.grad.numpy().reshape(expected.shape), expected, rtol=1e-4, atol=1e-4)

    data = mi.Float(np.float32(x).ravel())
    dr.enable_grad(data)
    data.grad = mi.Float(np.float32(dx).ravel())
    derivative = dr.forward_to(run(data)).numpy().reshape(geometry.nDetector[::-1]).T
    np.testing.assert_allclose(derivative, project_volume(dx, geometry)[0], rtol=1e-4, atol=1e-4)


def test_axis_conventions():
    """At angle 0 the source is on +x: +y goes to larger columns, +z to smaller rows, +x is magnified more."""
    geometry = scan(
        nVoxel=(21, 21, 21),
        dVoxel=(2.0, 2.0, 2.0),
        offOrigin=(0.0, 0.0, 0.0),
        offDetector=(0.0, 0.0),
        nDetector=(81, 81),
        dDetector=(1.0, 1.0),
        angles=np.radians([0.0, 90.0]),
    )

    def spot(i, j, k, view):
        volume = np.zeros(geometry.grid.shape)
        volume[i, j, k] = 1
        image = project_volume(volume, geometry)[view].astype(float)
        rows, columns = np.indices(image.shape) + 0.5 - 40.5
        return (image * columns).sum() / image.sum(), (image * rows).sum() / image.sum()

    np.testing.assert_allclose(spot(10, 15, 10, 0), (15, 0), atol=0.05)  # y = 10 mm, magnified 1.5
    np.testing.assert_allclose(spot(10, 10, 15, 0), (0, -15), atol=0.05)  # z = 10 mm
    np.testing.assert_allclose(spot(15, 15, 10, 0), (10 * 300 / 190, 0), atol=0.05)  # nearer to the source
    np.testing.assert_allclose(spot(15, 10, 10, 1), (-15, 0), atol=0.05)  # at 90 degrees u points to -x


def test_panel_offset_moves_the_image_the_other_way():
    settings = dict(
        nVoxel=(9, 9, 9), dVoxel=(3.0, 3.0, 3.0), dDetector=(3.0, 2.5), nDetector=(31, 31), offOrigin=(0.0, 0.0, 0.0)
    )
    geometry = scan(**settings, offDetector=(0.0, 0.0))
    volume = np.random.default_rng(0).random(geometry.grid.shape)
    centred = project_volume(volume, geometry)
    shifted = project_volume(volume, scan(**settings, offDetector=(6.0, 5.0)))
    # Two rows towards +z (smaller row numbers), two columns towards +u.
    np.testing.assert_allclose(shifted[:, 2:, :-2], centred[:, :-2, 2:], rtol=1e-4, atol=1e-4)


def test_one_kernel_for_all_views():
    geometry = scan(n=5)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        project_volume(np.random.default_rng(0).random(geometry.grid.shape), geometry)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len({kernel['hash'] for kernel in history}) == 1 and len(history) == 5


def test_progress_is_called_for_every_view():
    calls = []
    project_volume(np.ones((9, 11, 7)), scan(), progress=lambda done, n: calls.append((done, n)))
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_errors():
    with pytest.raises(InputError, match='shape'):
        project_volume(np.ones((3, 3, 3)), scan())
    with pytest.raises(InputError, match='NaN'):
        project_volume(np.full((9, 11, 7), np.nan), scan())
    with pytest.raises(InputError, match='values'):
        line_integrals(mi.Float([1, 2, 3]), (1, 1, 2), [0, 0, 0], [1, 1, 1], Lines(mi.Point3f(0), mi.Vector3f(1)))


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_origins_of_rays_are_near_the_volume(mode):
    """They lie on a plane through its centre, so that the distance of a source costs no digits."""
    geometry = scan(mode)
    table = view_table(geometry).astype(float)
    centre, source = table[:, :3], table[:, 9:12] / np.linalg.norm(table[:, 9:12], axis=1, keepdims=True)
    normal = np.cross(geometry.rays().u, geometry.rays().v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.abs(np.sum(centre * normal, 1)).max() < 1e-4 and np.isfinite(source).all()
