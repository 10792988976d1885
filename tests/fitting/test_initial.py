"""The initial cloud of a fit, whatever makes it."""

from types import SimpleNamespace

import pytest

from helpers.fits import geometry, tiny_scan
from lingo_mi.fitting import initial
from lingo_mi.fitting.recipes import METHODS


@pytest.mark.parametrize(
    'method, changes, waited',
    [
        ('r2', dict(n_points=50), 7),
        ('lingo', dict(n_points=50, init_density='fdk'), 7),
        ('3dgs', dict(n_points=50), 0),
        ('xgaussian', dict(cuboid_step=16), 0),
    ],
)
def test_the_seconds_are_those_of_all_steps(monkeypatch, method, changes, waited):
    """By a clock on which an FDK reconstruction takes 7 seconds, and nothing else any time."""
    now = [100.0]

    class Slow(initial.FDK):
        def run(self, scan):
            now[0] += 7
            return super().run(scan)

    monkeypatch.setattr(initial, 'time', SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(initial, 'FDK', Slow)
    cloud = initial.initial_cloud(tiny_scan(geometry()), METHODS[method].changed(**changes))
    assert cloud.info['seconds'] == waited
