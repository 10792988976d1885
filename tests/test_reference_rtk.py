"""FDK against RTK on the same projections (needs the `reference` extra)."""
import numpy as np
import pytest
import rtk
from test_fdk import BALL, centres, ellipsoids, geometry

from lingo_mi.geometry import circular
from lingo_mi.recon.fdk import fdk

itk = pytest.importorskip('itk', reason="RTK is not installed: pip install -e '.[reference]'")
if not hasattr(itk, 'RTK'):
    pytest.skip("ITK has no RTK: pip install -e '.[reference]'", allow_module_level=True)

BODIES = BALL, (np.array([-25., 20., -10.]), np.array([12., 18., 15.]), 0.01)


def test_fdk_agrees_inside_the_field_of_view():
    """An asymmetric object, a volume off the centre, voxels and counts that differ along the axes."""
    geo = geometry(angles=circular(20, start=3), offDetector=(0., 0.))
    scan, x = ellipsoids(geo, *BODIES), centres(geo)
    ours, theirs = fdk(scan), rtk.reconstruct('FDK', scan, itk)
    seen = np.hypot(x[..., 0], x[..., 1]) < 55
    assert np.sqrt(np.mean((ours - theirs)[seen] ** 2)) < 0.01 * 0.02
    assert theirs[seen].std() > 0.05 * 0.02
