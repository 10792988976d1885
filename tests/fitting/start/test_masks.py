"""LINGO's start and its densities, against the paper's equations written as loops."""

import numpy as np
import pytest

from helpers.sphere import sphere_scan
from lingo_mi.common.errors import InputError
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.start import density as densities
from lingo_mi.fitting.start.density import FAINTEST
from lingo_mi.fitting.start.masks import MaskStart, draw_cells
from lingo_mi.lingo.density import mean_pixel
from lingo_mi.lingo.masks import masks
from lingo_mi.lingo.scaling import occupancy
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres
from lingo_mi.scan import Scan

PAPER = MaskStart(n_points=2000, density='paper')


def test_draw_repeats_only_when_it_must_and_evenly():
    rng = np.random.default_rng(0)
    cells, repeat = draw_cells(np.arange(10) + 5, 7, rng)
    assert len(set(cells)) == 7 and not repeat.any()
    cells, repeat = draw_cells(np.arange(10) + 5, 25, rng)
    assert np.bincount(cells)[5:].min() == 2 and np.bincount(cells).max() == 3
    assert repeat.sum() == 15 and len(set(cells[~repeat])) == 10
    assert len(draw_cells(np.arange(10), 0, rng)[0]) == 0


def test_points_stay_within_a_flat_volume():
    """In a volume half as wide and a quarter as high as deep, each point stays in its cell."""
    geometry, _, projections = sphere_scan(0.2, centre=(0, 0, 0), nVoxel=(24, 48, 12))
    cloud = PAPER.from_views(Scan(geometry, projections), np.random.default_rng(1))
    assert cloud.info['repeats'] > 200
    side = 2 * geometry.grid.half / np.array(cloud.info['grid'])
    assert (np.linalg.norm(cloud.points, axis=1) < 0.2 + np.linalg.norm(side)).all()


def test_cloud_follows_the_paper():
    geometry, frames, projections = sphere_scan()
    cloud = PAPER.from_views(Scan(geometry, projections), np.random.default_rng(1))
    info, masked = cloud.info, masks(projections)
    assert info['method'] == 'masks'
    assert info['P'] == occupancy(frames, masked, geometry.grid.half, geometry.grid.shape)
    assert info['S'] == max(info['P'] * 20, 1)
    grid = tuple(max(round(n / info['S']), 8) for n in geometry.grid.shape)
    assert info['grid'] == grid
    assert len(cloud) == 2000 and info['points_high'] == 500 and info['points_low'] == 1500
    low, high = valid_voxels(frames, masked, grid, geometry.grid.half)
    assert (info['cells_low'], info['cells_high']) == (len(low), len(high))
    size = 2 * geometry.grid.half / grid
    cells = np.floor((cloud.points + geometry.grid.half) / size).astype(int)
    flat = np.ravel_multi_index(cells.T, grid)
    assert np.isin(flat[:500], high).all() and np.isin(flat[500:], low).all()
    offset = cloud.points - voxel_centres(grid, geometry.grid.half, flat)
    assert (np.abs(offset[:500]).max(0) > 0.4 * size).all()  # jittered over the cell
    first = min(1500, len(low))
    np.testing.assert_allclose(offset[500 : 500 + first], 0, atol=1e-12)
    assert info['repeats'] == max(1500 - len(low), 0) + max(500 - len(high), 0)
    np.testing.assert_allclose(
        cloud.density, mean_pixel(frames, projections, voxel_centres(grid, geometry.grid.half, flat))
    )
    np.testing.assert_allclose(cloud.spacing, neighbour_distance(cloud.points, 1.0))


def test_cloud_lies_in_the_object():
    geometry, frames, projections = sphere_scan(n=20)
    cloud = PAPER.from_views(Scan(geometry, projections), np.random.default_rng(0))
    distance = np.linalg.norm(cloud.points - (0.2, -0.1, 0.15), axis=1)
    assert distance.max() < 0.5 * 1.2 and (distance < 0.5).mean() > 0.9
    np.testing.assert_allclose(cloud.points.mean(0), (0.2, -0.1, 0.15), atol=0.03)


def test_same_seed_same_cloud():
    geometry, frames, projections = sphere_scan()
    a, b, c = (PAPER.from_views(Scan(geometry, projections), np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(a.points, c.points)


def test_more_points_than_cells():
    geometry, frames, projections = sphere_scan(nVoxel=(8, 8, 8), dVoxel=(0.25,) * 3)
    cloud = PAPER.from_views(Scan(geometry, projections), np.random.default_rng(0))
    assert len(cloud) == 2000 and cloud.info['repeats'] > 1000
    assert len(np.unique(cloud.points, axis=0)) == 2000 and (cloud.spacing > 0).all()


def test_density_modes(monkeypatch):
    geometry, frames, projections = sphere_scan()
    calls = []

    def render(points, density, spacing, views):
        calls.append((len(points), views.tolist()))
        return 4 * projections[views]

    def cloud(**settings):
        start = MaskStart(n_points=300, **settings)
        return start.from_views(Scan(geometry, projections), np.random.default_rng(0), render)

    monkeypatch.setattr(densities, 'VIEWS', 3)
    paper, r2, lsq = cloud(density='paper'), cloud(density='r2'), cloud(density='lsq')
    np.testing.assert_allclose(r2.density, 0.15 * paper.density)
    np.testing.assert_allclose(lsq.density, 0.25 * paper.density)
    assert calls == [(300, [0, 2, 4])] and lsq.info['density_factor'] == pytest.approx(0.25)
    with pytest.raises(InputError, match='render'):
        MaskStart().from_views(Scan(geometry, projections), np.random.default_rng(0))


def test_densities_of_an_fdk_volume():
    """A volume that is linear along each axis is its own interpolation; faint densities are raised to a lower bound."""
    geometry, frames, projections = sphere_scan()
    slope = np.array([0.3, 0.2, 0.1])
    axes = [(2 * np.arange(n) + 1) / n - 1 for n in geometry.grid.shape]  # times `half`: the voxels' centres
    volume = sum(s * h * x for s, h, x in zip(slope, geometry.grid.half, np.meshgrid(*axes, indexing='ij')))

    def cloud(**more):
        return MaskStart(n_points=300, density='fdk').from_views(
            Scan(geometry, projections),
            np.random.default_rng(0),
            lambda points, density, spacing, views: projections[views] / 4,
            **more,
        )

    filled = cloud(fdk=volume)
    expected = np.maximum(filled.points @ slope, FAINTEST * volume.max())
    assert (expected > FAINTEST * volume.max()).any() and (filled.points @ slope < 0).any()
    np.testing.assert_allclose(filled.density, 4 * expected, rtol=1e-6)
    with pytest.raises(InputError, match='reconstruction'):
        cloud()


def test_empty_high_set_leaves_all_to_the_low_set():
    geometry, frames, projections = sphere_scan()
    projections = projections.copy()
    projections[0, :2, :2] = 60.0  # one bright corner: nothing but it is above this view's threshold
    masked = masks(projections)
    assert len(valid_voxels(frames, masked, (16, 16, 16), geometry.grid.half)[1]) == 0
    start = MaskStart(n_points=100, density='paper', low_factor=0.001)
    cloud = start.from_views(Scan(geometry, projections), np.random.default_rng(0))
    assert cloud.info['points_high'] == 0 and len(cloud) == 100


def test_errors_say_what_to_do():
    geometry, frames, projections = sphere_scan()
    with pytest.raises(InputError, match='truncated'):
        PAPER.from_views(Scan(geometry, 0 * projections), np.random.default_rng(0))
    with pytest.raises(InputError, match='paper'):
        MaskStart(density='mean')
    with pytest.raises(InputError, match='high_fraction'):
        MaskStart(high_fraction=2)


def test_single_slice():
    geometry, frames, projections = sphere_scan(nDetector=(1, 64), nVoxel=(48, 48, 1), centre=(0.2, -0.1, 0.0))
    cloud = PAPER.from_views(Scan(geometry, projections), np.random.default_rng(0))
    assert len(cloud) == 2000 and cloud.info['grid'][2] == 1
    np.testing.assert_allclose(cloud.points[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(cloud.points.mean(0), (0.2, -0.1, 0), atol=0.06)


def test_parallel_beam():
    geometry, frames, projections = sphere_scan(mode='parallel')
    cloud = PAPER.from_views(Scan(geometry, projections), np.random.default_rng(0))
    np.testing.assert_allclose(cloud.points.mean(0), (0.2, -0.1, 0.15), atol=0.05)
