"""Voxels as boxes: their projections are projections of boxes."""

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.scan import Dataset
from studies.box_voxels import with_boxes


def test_rays_through_one_voxel():
    """Parallel rays along x have the length within the voxel, and nothing beside it, except at the edges of its pieces."""
    volume = np.zeros((5, 5, 5), np.float32)
    volume[2, 2, 2] = 1
    geometry = lm.Geometry.parallel(nDetector=(1, 40), dDetector=0.1, nVoxel=5, dVoxel=1.0, angles=[0.0])
    data = lm.simulate(volume, geometry, progress=False)
    projections = with_boxes(data, 8).train.projections[0, 0]
    u = np.abs(np.arange(40) - 19.5) * 0.1  # distance from the middle of the voxel, mm
    np.testing.assert_allclose(projections[u < 0.43], 1, atol=1e-5)
    np.testing.assert_allclose(projections[u > 0.57], 0, atol=1e-5)
    assert data.train.projections[0, 0][u > 0.57].max() > 0.3  # the trilinear interpolant reaches into the neighbours
    assert with_boxes(data, 8).train.geometry.grid.shape == (5, 5, 5)


def test_no_volume():
    geometry = lm.Geometry.parallel(nDetector=(1, 4), dDetector=1.0, nVoxel=5, dVoxel=1.0, angles=[0.0])
    with pytest.raises(InputError, match='true volume of this scan is not known'):
        with_boxes(Dataset(lm.Scan(geometry, np.ones((1, 1, 4), np.float32))))
