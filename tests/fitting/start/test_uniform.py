"""Starts that do not depend on the projections."""

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.start.uniform import CuboidStart, RandomStart
from lingo_mi.geometry import Geometry
from lingo_mi.scan import Scan


def cloud_of(start, shape):
    """The cloud of a start in a volume of so many voxels, whose projections are empty."""
    geometry = Geometry.cone(DSO=1e4, DSD=2e4, nDetector=4, dDetector=1, nVoxel=shape, dVoxel=1, angles=np.zeros(1))
    return start.cloud(Scan(geometry, np.zeros((1, 4, 4), np.float32)), np.random.default_rng(0), None, 1.0)


def test_random_points_fill_the_volume():
    half = np.array([1, 0.5, 0.25])
    cloud = cloud_of(RandomStart(4000), (16, 8, 4))
    assert len(cloud) == 4000 and np.all(np.abs(cloud.points) <= half)
    np.testing.assert_allclose(cloud.points.std(0), half / np.sqrt(3), rtol=0.05)
    assert not cloud_of(RandomStart(10), (16, 8, 1)).points[:, 2].any()


def test_cuboid():
    cloud = cloud_of(CuboidStart(8), (20, 9, 8))
    assert len(cloud) == 3 * 2 * 1
    np.testing.assert_allclose(np.unique(cloud.points[:, 0]), [-0.95, -0.15, 0.65])
    np.testing.assert_allclose(np.unique(cloud.points[:, 2]), [-0.35])
    with pytest.raises(InputError, match='cuboid_step'):
        cloud_of(CuboidStart(2), (512, 512, 512))
