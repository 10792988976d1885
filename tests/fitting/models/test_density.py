"""Fitted Gaussians with densities, in other geometries than their scan's."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from helpers.fits import SHORT, geometry, tiny_scan
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.r2 import R2
from lingo_mi.fitting.models import density
from lingo_mi.fitting.view_loss import MeasuredView
from lingo_mi.functional import voxelize
from lingo_mi.geometry.grid import Grid


@pytest.fixture(scope='module')
def fitted():
    return run(tiny_scan(geometry()), SHORT.changed(iterations=2))


def test_images_do_not_depend_on_the_voxels_of_a_geometry(fitted):
    g = fitted.geometry
    expected = fitted.render(g)
    for n, factor, shift in ((3, 2.0, 0.0), (7, 0.5, 4.0)):
        other = g.on(Grid((n,) * 3, tuple(factor * d for d in g.grid.spacing), (shift,) * 3))
        np.testing.assert_allclose(fitted.render(other), expected, atol=1e-5 * expected.max())


def test_images_do_not_depend_on_where_the_panel_stands(fitted):
    """It stands in the middle of the volume, or behind it with the same rays."""
    g = fitted.geometry
    middle = replace(g, DSD=g.DSO, dDetector=tuple(d * g.DSO / g.DSD for d in g.dDetector))
    expected = fitted.render(g)
    np.testing.assert_allclose(fitted.render(middle), expected, atol=1e-5 * expected.max())


def test_progress_counts_the_views(fitted):
    seen = []
    fitted.render(fitted.geometry, progress=lambda done, of: seen.append((done, of)))
    n = len(fitted.geometry)
    assert seen == [(k, n) for k in range(1, n + 1)]


def test_the_volume_on_another_grid(fitted):
    """Smaller voxels in a part of the volume, off its centre, hold the cloud's densities at these places."""
    g = fitted.geometry
    part = Grid((6, 5, 4), tuple(0.4 * d for d in g.grid.spacing), (3.0, -2.0, 1.0))
    volume = fitted.volume(part)
    expected = voxelize(*fitted.gaussians, part, extent=fitted.method.extent)
    assert volume.shape == (6, 5, 4) and expected.max() > 0
    np.testing.assert_allclose(volume, expected, atol=1e-4 * expected.max())


def test_gaussians_on_the_faces_of_the_volume_stay():
    half = np.array([1.0, 2.0, 3.0])
    centre = np.array([half, -half, half * (1, 1, 1.001)])
    stays = R2().forward.may_stay(centre, np.ones((3, 3)), half, 1.0)
    np.testing.assert_array_equal(stays, [True, True, False])


def test_pixels_are_compared_in_units_of_their_noise():
    """Weights multiply both images."""
    scan = tiny_scan(geometry())
    weights = np.random.default_rng(0).uniform(0.5, 2, scan.projections.shape).astype(np.float32)
    plain, weighted = (MeasuredView.of(scan, 1, 1.0, w).pixels for w in (None, weights))
    np.testing.assert_allclose(weighted.numpy(), plain.numpy() * weights[1].ravel(), rtol=1e-6)
    np.testing.assert_array_equal(MeasuredView.of(scan, 1, 1.0, weights).weights.numpy(), weights[1].ravel())


def test_a_large_volume_is_made_in_slabs(monkeypatch, scene):
    import lingo_mi as lm

    result = lm.fit(lm.simulate(scene), 'fast', iterations=10, n_points=100, progress=False)
    grids = None, Grid((20, 30, 17), (1.1, 0.8, 0.9))
    whole = [result.volume(grid) for grid in grids]
    monkeypatch.setattr(density, 'AT_ONCE', 24 * 24 * 12)
    slabs = mock.Mock(side_effect=density.voxelize)
    monkeypatch.setattr(density, 'voxelize', slabs)
    for grid, want in zip(grids, whole):
        volume = result.volume(grid)
        assert volume.shape == want.shape and abs(volume - want).max() < 2e-6 * want.max() and want.max() > 0
    assert slabs.call_count == 8 + 9  # of 3 and of 2 slices each
