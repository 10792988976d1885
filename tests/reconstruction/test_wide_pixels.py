"""Pixels wider than voxels: no pattern of the rays in a volume, no voxels left out."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lingo_mi import phantoms
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.metrics.quality import psnr_3d_r2
from lingo_mi.phantoms.x3d_scan import default_geometry
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.reconstruction import ASDPOCS, OSSART, SART, SIRT, Refined
from lingo_mi.reconstruction.refined import structure
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.wide_pixels import blurred, excess_width
from lingo_mi.scan import Scan


def test_blurred_is_that_of_scipy():
    rng = np.random.default_rng(0)
    for size, deviations in (
        ((9, 8, 7), (0.5, 1.2, 0.3)),
        ((9, 8, 7), (2, 0, 0)),
        ((6, 5, 1), (0, 0.4, 1)),
        ((3, 4, 5), (3, 4, 5)),
    ):
        volume = rng.normal(size=size)
        np.testing.assert_allclose(
            blurred(mi.Float(volume.ravel()), size, deviations).numpy().reshape(size),
            gaussian_filter(volume, deviations, radius=[int(4 * s) for s in deviations]),
            atol=1e-6,
        )
    np.testing.assert_allclose(blurred(mi.Float(volume.ravel()), size, (1e18,) * 3).numpy(), volume.mean(), atol=0.1)


def test_excess_width():
    """Magnified 1.5 times, pixels are 2 mm wide and 4 mm high at the axis."""
    geo = CircularGeometry(
        DSO=400, DSD=600, nDetector=(8, 8), dDetector=(6, 3), angles=circular(3), grid=Grid((4, 4, 4), (1, 2, 2))
    )
    np.testing.assert_allclose(excess_width(geo), (0.5**0.5, 0, 0.5**0.5), rtol=1e-6)
    np.testing.assert_allclose(excess_width(geo.on(replace(geo.grid, spacing=(2.01, 2.01, 4.01)))), 0)
    np.testing.assert_allclose(excess_width(replace(geo, mode='parallel', dDetector=(2, 1))), (0, 0, 0))
    np.testing.assert_allclose(excess_width(replace(geo, mode='parallel', dDetector=(4, 2))), (0.5**0.5, 0, 0.5**0.5))


@pytest.mark.parametrize('algorithm', [SART, OSSART, SIRT, ASDPOCS])
def test_voxels_between_rays(algorithm):
    """Rows 2.3 voxels apart at the axis miss some voxels there, which become like those around them. Beyond the panel, only
    total variation changes anything."""
    made = phantoms.Phantom(np.ones((24, 24, 36), np.float32), (2.0, 2.0, 1.0), 'block')
    geo = default_geometry(made, circular(30), 64)
    geo = replace(geo, nDetector=(8, 64), dDetector=(2.3 * geo.DSD / geo.DSO, geo.dDetector[1]))
    A = Joseph(geo)
    crossed = A.adjoint(dr.ones(mi.Float, 30 * A.pixels), np.arange(30)).numpy().reshape(geo.grid.shape) > 0
    assert not crossed[11:13, 11:13, 10:26].all() and not crossed[:, :, 0].any()
    volume = run_algorithm(Scan(geo, project_volume(made.data, geo)), algorithm(8)).volume
    centre = volume[11:13, 11:13, 9:27]
    assert np.abs(centre - 1).max() < 0.03, centre[0, 0]
    assert volume[:, :, :5].max() < (0.03 if algorithm is ASDPOCS else 1e-6)


def test_wide_pixels_leave_no_pattern():
    """Pixels are twice as wide as the voxels, and the smooth error of the start is corrected smoothly."""
    made = phantoms.make('foot', 48)
    geo = default_geometry(made, circular(12, 180.0), 24)
    assert min(excess_width(geo)) > 0.5
    scan = Scan(geo, project_volume(made.data, geo))
    wrong = np.float32(0.1 * made.data.max()) * np.asarray(gaussian_filter(np.float32(made.data > 0), 3), np.float32)
    start = made.data + wrong
    volume = run_algorithm(scan, Refined(4, 0, 1), completed=scan, sample=lambda _: start).volume
    plain = ASDPOCS(4, tviter=1, alpha=0.12, alpha_red=0.87, rmax=0.65, maxl2err=0.0, exact_every=5)
    plain = run_algorithm(scan, plain, start=start, weights=structure(start)).volume
    assert psnr_3d_r2(volume, made.data) > psnr_3d_r2(plain, made.data) + 0.5, [
        psnr_3d_r2(v, made.data) for v in (volume, plain, start)
    ]
