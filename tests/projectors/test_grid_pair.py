"""The exact projector pair of iterative algorithms: scans off the circle, and pixels left out."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.balls import BALL, assert_ball, ellipsoids, geometry
from helpers.grids import backproject, scan
from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular, helix
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.projectors.tilted_joseph import TiltedJoseph
from lingo_mi.reconstruction import ALGORITHMS, SART
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.system import System
from lingo_mi.scan import Scan


def moved(geo, shift=0.0, turn=(0.0, 0.0, 0.0)):
    """The geometry with source and panel turned (rotation vector, radians) and shifted along z (mm, one or one a view)."""
    n = len(geo)
    turns = Rotation.from_rotvec(np.tile(turn, (n, 1))).as_matrix()
    shifts = np.broadcast_to(np.reshape(shift, (-1, 1)) * [0, 0, 1.0], (n, 3))
    return Geometry.from_poses(geo.rays().moved(turns, shifts), geo.nDetector, grid=geo.grid)


def laminography(geo):
    return moved(geo, turn=(0.3, 0, 0))


def spiral(geo, pitch):
    return moved(geo, helix(geo.angles - np.pi, pitch))


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('masked', [False, True])
def test_a_matrix_and_its_transpose(mode, masked):
    """`forward` and `adjoint` of any views agree with `grid`, with pixels left out."""
    geo = laminography(scan(mode, n=3))
    rng, n = np.random.default_rng(0), geo.nDetector
    valid = rng.random((3, *n)) < 0.7 if masked else np.ones((3, *n), bool)
    A, chosen = GridPair(geo, valid if masked else None), [2, 0]
    x, y = rng.random(geo.grid.shape), rng.normal(size=(2, *n)) * valid[chosen]

    def images(projections):
        return projections.transpose(0, 2, 1).ravel()

    actual, paths = A.forward(mi.Float(np.float32(x).ravel()), chosen)
    expected, boxes = ((project_volume(v, geo) * valid)[chosen] for v in (x, np.ones_like(x)))
    np.testing.assert_allclose(actual.numpy(), images(expected), atol=2e-6 * expected.max())
    np.testing.assert_allclose(paths.numpy(), images(boxes), atol=2e-6 * boxes.max())
    anything = y if not masked else np.where(valid[chosen], y, 7.0)  # what stands in pixels left out counts for nothing
    actual = A.adjoint(A.images(anything), chosen)
    expected = backproject(y, geo.subset(chosen))
    np.testing.assert_allclose(actual.numpy(), expected.ravel(), atol=2e-6 * np.abs(expected).max())
    voxel, total, ones = A.adjoint(A.images(anything), chosen, lambda *values: values)
    np.testing.assert_array_equal(voxel.numpy(), np.arange(x.size))
    np.testing.assert_allclose(total.numpy(), actual.numpy(), atol=2e-6 * np.abs(expected).max())
    expected = backproject(valid[chosen].astype(float), geo.subset(chosen))
    np.testing.assert_allclose(ones.numpy(), expected.ravel(), atol=2e-6 * expected.max())
    product = np.vdot(A.forward(mi.Float(np.float32(x).ravel()), chosen)[0].numpy().astype(float), images(y))
    assert abs(product - np.vdot(x, backproject(y, geo.subset(chosen)))) < 1e-5 * np.linalg.norm(x) * np.linalg.norm(
        expected
    )


def test_which_projector_a_scan_gets():
    geo = scan(n=3)
    ones = np.ones((3, *geo.nDetector), np.float32)
    valid = np.arange(ones.size).reshape(ones.shape) > 0
    assert isinstance(System(Scan(geo, ones)).A, Joseph)
    assert isinstance(System(Scan(geo, ones, valid)).A, Joseph)
    assert isinstance(System(Scan(spiral(geo, 20.0), ones)).A, Joseph)
    assert isinstance(System(Scan(laminography(geo), ones)).A, TiltedJoseph)
    assert isinstance(System(Scan(scan(n=3, DSO=26.0, DSD=300.0), ones, valid)).A, GridPair)
    with pytest.raises(InputError, match='lies within'):
        System(Scan(scan(n=3, DSO=15.0, DSD=300.0), ones, valid))


@pytest.mark.parametrize(
    'name, views, options',
    [
        ('sart', 40, dict(niter=3)),
        ('os-sart', 60, dict(niter=4, blocksize=6)),
        pytest.param('cgls', 120, dict(niter=12), marks=pytest.mark.thorough),
        ('asd-pocs', 40, dict(niter=3)),
    ],
)
def test_helix(name, views, options):
    """The ball comes back from two turns that climb by 20 mm each."""
    geo = spiral(geometry(angles=4 * np.pi * np.arange(views) / views), 20.0)
    assert_ball(run_algorithm(ellipsoids(geo, BALL), ALGORITHMS[name](**options)).volume, geo)


def test_pixels_left_out_count_for_nothing():
    """A quarter of the pixels is dead, whatever stands in them. Taken for zero, they would spoil the volume."""
    geo = geometry(angles=circular(40, start=3))
    whole = ellipsoids(geo, BALL)
    valid = np.random.default_rng(0).random(whole.projections.shape) < 0.75
    dead = replace(whole, projections=np.where(valid, whole.projections, np.nan), valid=valid)
    result = run_algorithm(dead, SART(3))
    assert_ball(result.volume, geo)
    assert result.residuals[-1] < 0.1
    with pytest.raises(AssertionError):
        assert_ball(
            run_algorithm(replace(whole, projections=np.where(valid, whole.projections, 0)), SART(3)).volume, geo
        )


def test_kernels_serve_any_views():
    """Once an algorithm has run, longer runs and other views compile nothing."""
    geo = laminography(scan(n=5))
    measured = Scan(geo, np.random.default_rng(0).random((5, *geo.nDetector)).astype(np.float32))
    for algorithm in ('sart', 'cgls'):
        run_algorithm(measured, ALGORITHMS[algorithm](niter=2))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            run_algorithm(measured.subset([0, 2, 3]), ALGORITHMS[algorithm](niter=3))
            assert all(k['cache_hit'] for k in dr.kernel_history([dr.KernelType.JIT]))
