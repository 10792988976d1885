"""Views between the measured ones."""

import numpy as np
import pytest

from helpers.balls import BALL, ellipsoids, geometry
from lingo_mi.common.errors import InputError
from lingo_mi.completion.views import at_turns, insert_views
from lingo_mi.geometry import CurvedGeometry, Geometry, circular
from lingo_mi.geometry.trajectories import helix

PANEL = dict(nDetector=(16, 25), dDetector=(12.0, 16.0))  # an arc of 51 degrees


@pytest.mark.parametrize('offset', [(4.0, 0.0), (4.0, 4.0)])
def test_a_curved_panel(offset):
    """Half of the views complete the scan of all, on a panel that is centred or a quarter of a pixel off."""
    every = geometry(angles=circular(12, start=3), offDetector=offset, **PANEL).curved()
    half = ellipsoids(every.subset(slice(None, None, 2)), BALL)
    full = insert_views(half, 12, lambda views: ellipsoids(views, BALL).projections)
    assert isinstance(full.geometry, CurvedGeometry)
    angles = np.degrees(np.arctan2(*full.geometry.rays(curved=True).source.T[1::-1])) % 360
    expected = ellipsoids(every, BALL).projections
    np.testing.assert_allclose(full.projections[np.argsort(angles)], expected, atol=1e-5 * expected.max())


def test_what_is_no_circle():
    flat = geometry(angles=circular(12), **PANEL)
    climbing = Geometry.per_view(**flat.numbers(), height=helix(flat.angles, 20.0))
    for scan in (climbing, climbing.curved()):
        with pytest.raises(InputError, match='a source on a circle about z'):
            at_turns(scan, np.zeros(1))
