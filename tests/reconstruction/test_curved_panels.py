"""A uniform ball from curved panels, by algorithms on voxels."""

import numpy as np
import pytest

from helpers.balls import BALL, assert_ball, ellipsoids, geometry
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Geometry, circular
from lingo_mi.geometry.trajectories import helix
from lingo_mi.reconstruction import ALGORITHMS
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.penalised import PenalisedLeastSquares
from lingo_mi.reconstruction.rectify import rectified
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan

WIDE = dict(nDetector=(64, 100), dDetector=(3.0, 4.0))  # an arc of 51 degrees


def scan(views, offset=(4.0, 1.0), radius=None, **changes):
    return ellipsoids(
        geometry(angles=circular(views, start=3), offDetector=offset, **WIDE, **changes).curved(radius), BALL
    )


@pytest.mark.parametrize(
    'name, views, options',
    [
        ('sart', 40, dict(niter=3)),
        pytest.param('cgls', 120, dict(niter=12), marks=pytest.mark.thorough),
        ('asd-pocs', 40, dict(niter=5)),
    ],
)
def test_iterative(name, views, options):
    measured = scan(views)
    assert_ball(run_algorithm(measured, ALGORITHMS[name](**options)).volume, measured.geometry)


def test_penalised():
    """A strongly bent panel gives the ball, and one that is hardly bent gives the volume of the flat one."""
    algorithm = PenalisedLeastSquares(strength=1e-3, niter=40)
    coarse = dict(nDetector=(32, 50), dDetector=(6.0, 8.0), nVoxel=(24, 24, 24), dVoxel=6.0)
    measured = ellipsoids(geometry(angles=circular(20), **coarse).curved(), BALL)
    assert_ball(run_algorithm(measured, algorithm).volume, measured.geometry)
    small = dict(nDetector=(16, 25), dDetector=(12.0, 16.0), nVoxel=(12, 12, 12), dVoxel=11.0)
    flat = ellipsoids(geometry(angles=circular(12), **small), BALL)
    hardly = Scan(flat.geometry.curved(1e9), flat.projections)
    expected = run_algorithm(flat, algorithm).volume
    np.testing.assert_allclose(run_algorithm(hardly, algorithm).volume, expected, atol=1e-5 * expected.max())


@pytest.mark.parametrize(
    'offset, radius',
    [
        ((4.0, 0.0), None),
        ((4.0, 1.0), 380.0),
        ((4.0, 60.0), None),
        *(
            pytest.param((4.0, offset), radius, marks=pytest.mark.thorough)
            for offset, radius in ((0.0, 380.0), (1.0, None), (60.0, 380.0))
        ),
    ],
)
def test_fdk(offset, radius):
    """A panel that is centred, a quarter of a pixel off, or far to one side gives the ball, like a flat panel."""
    measured = scan(180, offset, radius)
    volume = run_algorithm(measured, FDK()).volume
    assert_ball(volume, measured.geometry)
    level = rectified(measured)
    assert isinstance(level.geometry, CircularGeometry)
    expected = ellipsoids(level.geometry, BALL).projections
    inside = expected > 0.8 * expected.max()  # the edge is not a spline
    assert np.abs(level.projections - expected)[inside].max() < 3e-3 * expected.max()


def test_fdk_of_one_row():
    geo = geometry(
        angles=circular(180), nDetector=(1, 100), dDetector=(3.0, 4.0), nVoxel=(36, 36, 1), dVoxel=(4.0, 4.0, 2.0),
        offOrigin=(0.0, 0.0, 0.0), offDetector=(0.0, 1.0),
    ).curved()  # fmt: skip
    body = np.array([12.0, -9.0, 0.0]), np.array([25.0, 25.0, 1e4]), 0.02
    volume = run_algorithm(ellipsoids(geo, body), FDK()).volume
    x, y = np.meshgrid(*[(np.arange(36) - 17.5) * 4] * 2, indexing='ij')
    assert volume[np.hypot(x - 12, y + 9) < 15].mean() == pytest.approx(0.02, rel=0.01)


def test_fdk_needs_a_circle():
    geo = geometry(angles=circular(12), **WIDE)
    climbing = Geometry.per_view(**geo.numbers(), height=helix(geo.angles, 20.0)).curved()
    with pytest.raises(InputError, match='source on a circle'):
        run_algorithm(ellipsoids(climbing, BALL), FDK())
