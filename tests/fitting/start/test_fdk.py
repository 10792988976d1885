"""The start of R2-Gaussian: voxels of an FDK volume."""

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.start.fdk import FDKStart


def test_points_are_voxels_above_the_threshold():
    rng = np.random.default_rng(0)
    volume, half = rng.random((6, 5, 4)).astype(np.float32), np.array([1.0, 5 / 6, 4 / 6])
    cloud = FDKStart(n_points=30, fdk_threshold=0.5).from_volume(volume, half, rng)
    assert len(cloud) == 30
    for point, density in zip(cloud.points, cloud.density):
        i, j, k = ((point + half) * 3 - 0.5).round().astype(int)
        np.testing.assert_allclose(point, (np.array([i, j, k]) + 0.5) / 3 - half, atol=1e-12)
        assert volume[i, j, k] > 0.5 and density == pytest.approx(0.15 * volume[i, j, k])
    assert len(np.unique(cloud.points, axis=0)) == 30
    np.testing.assert_allclose(cloud.spacing, neighbour_distance(cloud.points, 1.0))
    assert len(FDKStart(fdk_threshold=0.9).from_volume(volume, half, rng)) == (volume > 0.9).sum()
    denser = FDKStart(n_points=30, fdk_threshold=0.5).from_volume(volume, half, np.random.default_rng(1), unit=0.02)
    plain = FDKStart(n_points=30, fdk_threshold=0.5).from_volume(volume, half, np.random.default_rng(1))
    np.testing.assert_allclose(denser.density, 0.02 * plain.density)
    with pytest.raises(InputError, match='threshold'):
        FDKStart(fdk_threshold=2.0).from_volume(volume, half, rng)
