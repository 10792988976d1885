"""The start on edges: where its points lie, and what its densities are."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.balls import BALL, ellipsoids, geometry
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.start import edges
from lingo_mi.fitting.start.edges import EdgeStart
from lingo_mi.fitting.start.start import StartingCloud
from lingo_mi.geometry.trajectories import circular
from lingo_mi.scan import Scan

CENTRE, (RADIUS, *_), DENSITY = BALL


def scan(views=24, **changes):
    return ellipsoids(geometry(angles=circular(views), **changes), BALL)


def start(of, n_points=300, seed=0, factor=1.0, within='masks') -> StartingCloud:
    """The cloud of a scan whose rendering is its projections divided by `factor`."""
    render = lambda *a: of.normalised[a[-1]] / factor  # noqa: E731
    return EdgeStart(n_points, within).cloud(of, np.random.default_rng(seed), render, 1.0)


def distances(cloud, of):
    """Distances of the points from the ball's centre, in radii."""
    g = of.geometry
    return np.linalg.norm(cloud.points / g.grid.scale + np.array(g.grid.centre) - CENTRE, axis=1) / RADIUS


@pytest.fixture(scope='module')
def ball():
    return scan()


def test_points_lie_on_the_surface_and_fewer_inside(ball):
    cloud = start(ball)
    r = distances(cloud, ball)
    assert len(cloud) == 300 and len(np.unique(cloud.points, axis=0)) == 300
    assert (np.abs(r - 1) < 0.2).mean() > 0.8 and 0.02 < (r < 0.8).mean() < 0.2 and (r > 1.5).mean() < 0.02


def test_densities_are_those_of_the_volume_times_the_factor_of_the_projections(ball):
    cloud = start(ball, factor=4)
    assert cloud.info['method'] == 'edges' and cloud.info['density_factor'] == pytest.approx(4, rel=1e-6)
    deep = distances(cloud, ball) < 0.7
    assert deep.sum() > 10 and np.median(cloud.density[deep]) == pytest.approx(4 * DENSITY, rel=0.05)
    np.testing.assert_allclose(start(ball).density, cloud.density / 4, rtol=1e-6)


def test_the_seed_alone_decides(ball):
    a, b, c = (start(ball, 200, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(a.points, c.points)


def test_all_voxels_that_are_not_empty_where_they_are_fewer_than_points():
    few = scan(nVoxel=(12, 12, 12), dVoxel=(10.0, 10.0, 10.0))
    cloud = start(few, 2000)
    assert 20 < len(cloud) < 12**3 and len(cloud) == len(start(few, 5000))


def test_a_large_volume_is_thinned_with_its_pixels(ball, monkeypatch):
    """The points are where they were, to a voxel of the thinner volume."""
    monkeypatch.setattr(edges, 'LARGEST', 20)
    coarse = edges._coarse(ball)
    assert coarse.geometry.grid.shape == (16, 18, 14) and coarse.geometry.nDetector == (32, 36)
    assert coarse.geometry.grid.size == pytest.approx(ball.geometry.grid.size)
    r = distances(start(ball, 60), ball)
    assert (np.abs(r - 1) < 0.5).mean() > 0.8


def test_pixels_that_are_not_valid_are_not_binned(ball, monkeypatch):
    """One in four is invalid in every block, so that binning would leave none."""
    monkeypatch.setattr(edges, 'LARGEST', 20)
    valid = np.ones(ball.projections.shape, bool)
    valid[:, ::2, ::2] = False
    spoilt = np.where(valid, ball.projections, 100).astype(np.float32)
    r = distances(start(Scan(ball.geometry, spoilt, valid), 60), ball)
    assert (np.abs(r - 1) < 0.5).mean() > 0.8


def test_a_single_slice():
    flat = scan(
        nVoxel=(32, 36, 1), nDetector=(1, 72), offOrigin=(5.0, -4.0, 0.0), offDetector=(0.0, -7.0), mode='parallel'
    )
    assert (start(flat, 50).points[:, 2] == 0).all()


def test_nothing_to_see(ball):
    with pytest.raises(InputError, match='nothing to reconstruct'):
        start(replace(ball, projections=np.zeros_like(ball.projections)))


def with_speck(ball):
    """A scan with a bright pixel in one view: SART smears it along its ray, which the other views do not show."""
    projections = ball.projections.copy()
    projections[3, 4, 5] = 0.6 * projections.max()
    return replace(ball, projections=projections)


def test_points_lie_in_the_masks_of_all_views(ball):
    spoilt = with_speck(ball)
    free, masked = start(spoilt, 3000, within='volume'), start(spoilt, 3000)
    assert (distances(free, spoilt) > 1.5).sum() > 20 and (distances(masked, spoilt) > 1.5).sum() == 0
    assert masked.info['masks_used'] and 0 < masked.info['edges_lost'] < edges.MOST_LOST
    assert masked.info['T_low'] == pytest.approx(0.1 * masked.info['T_high'])
    volume = 4 / 3 * np.pi * np.prod(BALL[1]) / np.prod(ball.geometry.grid.spacing)
    assert 0.8 < masked.info['cells_low'] / volume < 1.3
    assert 'masks_used' not in free.info


def test_masks_that_cut_off_the_object_are_not_used(ball):
    """A view that shows nothing has an empty mask, and so has the intersection of all views."""
    projections = ball.projections.copy()
    projections[5] = 0
    blank = replace(ball, projections=projections)
    cloud = start(blank)
    assert not cloud.info['masks_used'] and cloud.info['edges_lost'] == 1 and cloud.info['cells_low'] == 0
    np.testing.assert_array_equal(cloud.points, start(blank, within='volume').points)
