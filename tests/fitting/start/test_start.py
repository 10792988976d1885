"""The start of a fit, whatever makes it."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.fits import geometry, tiny_scan
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.methods import cloud_method
from lingo_mi.fitting.methods.by_name import METHODS
from lingo_mi.reconstruction.fdk import FDK


@pytest.mark.parametrize(
    'method, changes, waited',
    [
        ('r2', dict(n_points=50), 7),
        ('lingo', dict(n_points=50, density='fdk'), 7),
        ('3dgs', dict(n_points=50), 0),
        ('xgaussian', dict(cuboid_step=16), 0),
    ],
)
def test_the_seconds_are_those_of_all_steps(monkeypatch, method, changes, waited):
    """On this clock an FDK reconstruction takes 7 seconds, and nothing else any time."""
    now, method = [100.0], METHODS[method].changed(**changes)

    class Slow(FDK):
        def _run(self, scan, **inputs):
            now[0] += 7
            return super()._run(scan, **inputs)

    monkeypatch.setattr(cloud_method, 'time', SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(sys.modules[type(method.start).__module__], 'FDK', Slow, raising=False)
    cloud = method.starting_cloud(tiny_scan(geometry()))
    assert cloud.info['seconds'] == waited


def test_neighbour_distance():
    points = np.random.default_rng(0).random((25, 3))
    result = neighbour_distance(points, 1.0)
    for i, point in enumerate(points):
        nearest = sorted(np.linalg.norm(points - point, axis=1))[1:4]
        assert abs(result[i] - np.sqrt(np.mean(np.square(nearest)))) < 1e-12
    assert neighbour_distance(points[:1], 0.3).tolist() == [0.3]
    np.testing.assert_allclose(neighbour_distance([[0, 0, 0], [0, 3, 4]], 1.0), 5)
