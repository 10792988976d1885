"""The bridge to MBIRJAX against exact line integrals: a panel off the central ray, a volume above the centre."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors import grid
from studies.benchmarks import mbirjax_bridge

SCAN = dict(DSO=200, DSD=300, nDetector=(48, 64), dDetector=1.5, nVoxel=(40, 40, 24), angles=[0, 0.7, 2.0, 4.5])


@pytest.mark.parametrize('placement', [dict(), dict(offDetector=(3.0, -5.0), offOrigin=(0, 0, 4.0))])
def test_projections_agree(placement):
    mbirjax = pytest.importorskip('mbirjax', reason="MBIRJAX is not installed: pip install -e '.[reference]'")
    geometry = Geometry.cone(dVoxel=1, **SCAN, **placement)
    volume = np.zeros(geometry.grid.shape, np.float32)
    volume[8:30, 12:20, 5:16], volume[20:34, 20:30, 8:12] = 0.02, 0.03
    volume = gaussian_filter(volume, 1.5)
    ours, theirs = grid.project_volume(volume, geometry), mbirjax_bridge.project(volume, geometry, mbirjax)
    assert np.abs(theirs - ours).max() < 0.007 * ours.max()


def test_what_it_has_no_model_for():
    for other in (
        Geometry.cone(dVoxel=(1, 1, 2), **SCAN),
        Geometry.cone(dVoxel=1, offOrigin=(2, 0, 0), **SCAN),
        Geometry.parallel(nDetector=8, dDetector=1, nVoxel=8, dVoxel=1, angles=[0, 1]),
    ):
        with pytest.raises(InputError, match='MBIRJAX'):
            mbirjax_bridge.model(other, None)
