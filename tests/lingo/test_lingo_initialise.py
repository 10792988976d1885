"""The initial clouds, their densities and IPSD, against the paper's equations written as loops."""

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.r2_start import r2_initialise
from lingo_mi.geometry.base import CircularGeometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.lingo import density as densities
from lingo_mi.lingo.density import FAINTEST, least_squares_factor, mean_pixel
from lingo_mi.lingo.initialise import LingoSettings, draw, initialise
from lingo_mi.lingo.masks import masks
from lingo_mi.lingo.scaling import occupancy
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres
from lingo_mi.metrics.ipsd import ipsd, neighbour_distance, reverse_distance
from lingo_mi.scan import Scan


def sphere_scan(radius=0.5, n=6, centre=(0.2, -0.1, 0.15), density=0.8, **changes):
    """A ball in the normalised frame: geometry, frames, projections (chord times density)."""
    settings = dict(
        DSO=5.0,
        DSD=7.0,
        nDetector=(64, 64),
        dDetector=(0.055, 0.055),
        nVoxel=(48, 48, 48),
        dVoxel=(2 / 48,) * 3,
        angles=circular(n, start=5),
    )
    geometry = CircularGeometry(**{**settings, **changes})
    frames, out = geometry.normalised_rays(), []
    x, y = np.meshgrid(np.arange(geometry.nDetector[1]) + 0.5, np.arange(geometry.nDetector[0]) + 0.5)
    for view in range(n):
        o, d = frames.through(view, x, y)
        away = np.cross(np.asarray(centre) - o, d / np.linalg.norm(d, axis=-1, keepdims=True))
        out.append(2 * density * np.sqrt(np.maximum(radius**2 - (away**2).sum(-1), 0)))
    return geometry, frames, np.array(out, np.float32)


PAPER = LingoSettings(n_points=2000, init_density='paper')


def test_mean_pixel_is_the_mean_over_the_views():
    geometry, frames, projections = sphere_scan()
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))
    result = mean_pixel(frames, projections, points)
    for point, value in zip(points, result):
        total = 0
        for o in range(len(frames)):
            (x,), (y,) = frames.project([point], o)
            total += projections[o, int(np.floor(y)), int(np.floor(x))]
        assert abs(value - total / len(frames)) < 1e-6
    assert mean_pixel(frames, projections, [[0, 0, 50.0]]) == 0  # no view sees it


def test_least_squares_factor_minimises():
    rng = np.random.default_rng(0)
    measured, rendered = rng.random((2, 4, 5)), rng.random((2, 4, 5))
    alpha = least_squares_factor(measured, rendered)
    best = ((measured - alpha * rendered) ** 2).sum()
    assert best < ((measured - (alpha + 1e-3) * rendered) ** 2).sum()
    assert best < ((measured - (alpha - 1e-3) * rendered) ** 2).sum()
    assert least_squares_factor(measured, 0 * rendered) == 1
    assert least_squares_factor(-measured, rendered) == 1


def test_ipsd():
    rng = np.random.default_rng(0)
    p, t = rng.random((30, 3)), rng.random((20, 3))
    literal = sum(min(np.linalg.norm(a - b) for b in t) for a in p) / len(p)
    assert abs(ipsd(p, t) - literal) < 1e-12
    reverse = sum(min(np.linalg.norm(a - b) for a in p) for b in t) / len(t)
    assert abs(reverse_distance(p, t) - reverse) < 1e-12
    assert np.isnan(ipsd(p, np.zeros((0, 3)))) and np.isnan(ipsd(np.zeros((0, 3)), t))


def test_neighbour_distance():
    points = np.random.default_rng(0).random((25, 3))
    result = neighbour_distance(points, 1.0)
    for i, point in enumerate(points):
        nearest = sorted(np.linalg.norm(points - point, axis=1))[1:4]
        assert abs(result[i] - np.sqrt(np.mean(np.square(nearest)))) < 1e-12
    assert neighbour_distance(points[:1], 0.3).tolist() == [0.3]
    np.testing.assert_allclose(neighbour_distance([[0, 0, 0], [0, 3, 4]], 1.0), 5)


def test_draw_repeats_only_when_it_must_and_evenly():
    rng = np.random.default_rng(0)
    cells, repeat = draw(np.arange(10) + 5, 7, rng)
    assert len(set(cells)) == 7 and not repeat.any()
    cells, repeat = draw(np.arange(10) + 5, 25, rng)
    assert np.bincount(cells)[5:].min() == 2 and np.bincount(cells).max() == 3
    assert repeat.sum() == 15 and len(set(cells[~repeat])) == 10
    assert len(draw(np.arange(10), 0, rng)[0]) == 0


def test_points_stay_within_a_flat_volume():
    """Half as wide and a quarter as high as deep: each point in its cell."""
    geometry, _, projections = sphere_scan(0.2, centre=(0, 0, 0), nVoxel=(24, 48, 12))
    cloud = initialise(Scan(geometry, projections), PAPER, np.random.default_rng(1))
    assert cloud.info['repeats'] > 200
    side = 2 * geometry.half / np.array(cloud.info['grid'])
    assert (np.linalg.norm(cloud.points, axis=1) < 0.2 + np.linalg.norm(side)).all()


def test_cloud_follows_the_paper():
    geometry, frames, projections = sphere_scan()
    cloud = initialise(Scan(geometry, projections), PAPER, np.random.default_rng(1))
    info, found = cloud.info, masks(projections)
    assert info['method'] == 'lingo'
    assert info['P'] == occupancy(frames, found, geometry.half, geometry.nVoxel)
    assert info['S'] == max(info['P'] * 20, 1)
    grid = tuple(max(round(n / info['S']), 8) for n in geometry.nVoxel)
    assert info['grid'] == grid
    assert len(cloud) == 2000 and info['points_high'] == 500 and info['points_low'] == 1500
    low, high = valid_voxels(frames, found, grid, geometry.half)
    assert (info['cells_low'], info['cells_high']) == (len(low), len(high))
    size = 2 * geometry.half / grid
    cells = np.floor((cloud.points + geometry.half) / size).astype(int)
    flat = np.ravel_multi_index(cells.T, grid)
    assert np.isin(flat[:500], high).all() and np.isin(flat[500:], low).all()
    offset = cloud.points - voxel_centres(grid, geometry.half, flat)
    assert (np.abs(offset[:500]).max(0) > 0.4 * size).all()  # jittered over the cell
    first = min(1500, len(low))
    np.testing.assert_allclose(offset[500 : 500 + first], 0, atol=1e-12)
    assert info['repeats'] == max(1500 - len(low), 0) + max(500 - len(high), 0)
    np.testing.assert_allclose(
        cloud.density, 0.15 * mean_pixel(frames, projections, voxel_centres(grid, geometry.half, flat))
    )
    np.testing.assert_allclose(cloud.spacing, neighbour_distance(cloud.points, 1.0))


def test_cloud_lies_in_the_object():
    geometry, frames, projections = sphere_scan(n=20)
    cloud = initialise(Scan(geometry, projections), PAPER)
    distance = np.linalg.norm(cloud.points - (0.2, -0.1, 0.15), axis=1)
    assert distance.max() < 0.5 * 1.2 and (distance < 0.5).mean() > 0.9
    np.testing.assert_allclose(cloud.points.mean(0), (0.2, -0.1, 0.15), atol=0.03)


def test_same_seed_same_cloud():
    geometry, frames, projections = sphere_scan()
    a, b, c = (initialise(Scan(geometry, projections), PAPER, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(a.points, c.points)


def test_more_points_than_cells():
    geometry, frames, projections = sphere_scan(nVoxel=(8, 8, 8), dVoxel=(0.25,) * 3)
    cloud = initialise(Scan(geometry, projections), PAPER)
    assert len(cloud) == 2000 and cloud.info['repeats'] > 1000
    assert len(np.unique(cloud.points, axis=0)) == 2000 and (cloud.spacing > 0).all()


def test_density_modes(monkeypatch):
    geometry, frames, projections = sphere_scan()
    calls = []

    def render(points, density, spacing, views):
        calls.append((len(points), views.tolist()))
        return 4 * projections[views]

    def cloud(**settings):
        return initialise(
            Scan(geometry, projections), LingoSettings(n_points=300, **settings), np.random.default_rng(0), render
        )

    monkeypatch.setattr(densities, 'LSQ_VIEWS', 3)
    raw, paper, lsq = cloud(init_density='raw'), cloud(init_density='paper'), cloud(init_density='lsq')
    np.testing.assert_allclose(paper.density, 0.15 * raw.density)
    np.testing.assert_allclose(lsq.density, 0.25 * raw.density)
    assert calls == [(300, [0, 2, 4])] and lsq.info['density_factor'] == pytest.approx(0.25)
    with pytest.raises(InputError, match='render'):
        initialise(Scan(geometry, projections), LingoSettings())


def test_densities_of_an_fdk_volume():
    """A volume that is a plane along each axis is its own interpolation; what is faint counts as a little."""
    geometry, frames, projections = sphere_scan()
    slope = np.array([0.3, 0.2, 0.1])
    axes = [(2 * np.arange(n) + 1) / n - 1 for n in geometry.nVoxel]  # times `half`: the voxels' centres
    volume = sum(s * h * x for s, h, x in zip(slope, geometry.half, np.meshgrid(*axes, indexing='ij')))

    def cloud(**more):
        return initialise(
            Scan(geometry, projections),
            LingoSettings(n_points=300, init_density='fdk'),
            np.random.default_rng(0),
            lambda points, density, spacing, views: projections[views] / 4,
            **more,
        )

    found = cloud(fdk=volume)
    expected = np.maximum(found.points @ slope, FAINTEST * volume.max())
    assert (expected > FAINTEST * volume.max()).any() and (found.points @ slope < 0).any()
    np.testing.assert_allclose(found.density, 4 * expected, rtol=1e-6)
    with pytest.raises(InputError, match='reconstruction'):
        cloud()


def test_empty_high_set_leaves_all_to_the_low_set():
    geometry, frames, projections = sphere_scan()
    projections = projections.copy()
    projections[0, :2, :2] = 60.0  # one bright corner: nothing but it is above this view's threshold
    found = masks(projections)
    assert len(valid_voxels(frames, found, (16, 16, 16), geometry.half)[1]) == 0
    settings = LingoSettings(n_points=100, init_density='raw', low_factor=0.001)
    cloud = initialise(Scan(geometry, projections), settings)
    assert cloud.info['points_high'] == 0 and len(cloud) == 100


def test_errors_say_what_to_do():
    geometry, frames, projections = sphere_scan()
    with pytest.raises(InputError, match='truncated'):
        initialise(Scan(geometry, 0 * projections), PAPER)
    with pytest.raises(InputError, match='paper'):
        LingoSettings(init_density='mean')
    with pytest.raises(InputError, match='high_fraction'):
        LingoSettings(high_fraction=2)


def test_single_slice():
    geometry, frames, projections = sphere_scan(nDetector=(1, 64), nVoxel=(48, 48, 1), centre=(0.2, -0.1, 0.0))
    cloud = initialise(Scan(geometry, projections), PAPER)
    assert len(cloud) == 2000 and cloud.info['grid'][2] == 1
    np.testing.assert_allclose(cloud.points[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(cloud.points.mean(0), (0.2, -0.1, 0), atol=0.06)


def test_parallel_beam():
    geometry, frames, projections = sphere_scan(mode='parallel')
    cloud = initialise(Scan(geometry, projections), PAPER)
    np.testing.assert_allclose(cloud.points.mean(0), (0.2, -0.1, 0.15), atol=0.05)


def test_r2_cloud():
    rng = np.random.default_rng(0)
    volume, half = rng.random((6, 5, 4)).astype(np.float32), np.array([1.0, 5 / 6, 4 / 6])
    cloud = r2_initialise(volume, half, rng, n_points=30, threshold=0.5)
    assert len(cloud) == 30
    for point, density in zip(cloud.points, cloud.density):
        i, j, k = ((point + half) * 3 - 0.5).round().astype(int)
        np.testing.assert_allclose(point, (np.array([i, j, k]) + 0.5) / 3 - half, atol=1e-12)
        assert volume[i, j, k] > 0.5 and density == pytest.approx(0.15 * volume[i, j, k])
    assert len(np.unique(cloud.points, axis=0)) == 30
    np.testing.assert_allclose(cloud.spacing, neighbour_distance(cloud.points, 1.0))
    assert len(r2_initialise(volume, half, rng, threshold=0.9)) == (volume > 0.9).sum()
    with pytest.raises(InputError, match='threshold'):
        r2_initialise(volume, half, rng, threshold=2.0)


def test_the_factor_is_that_of_eight_views():
    geometry, frames, projections = sphere_scan(n=16)
    seen = []

    def render(points, density, spacing, views):
        seen.extend(views.tolist())
        return projections[views]

    initialise(Scan(geometry, projections), LingoSettings(n_points=300), np.random.default_rng(0), render)
    assert seen == [0, 2, 4, 6, 8, 10, 12, 14]
