"""Mean pixels, against the paper's equation written as loops."""

import numpy as np

from helpers.sphere import sphere_scan
from lingo_mi.lingo.density import mean_pixel


def test_mean_pixel_is_the_mean_over_the_views():
    geometry, frames, projections = sphere_scan()
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))
    result = mean_pixel(frames, projections, points)
    for point, value in zip(points, result):
        total = 0
        for o in range(len(frames)):
            (x,), (y,) = frames.project([point], o)
            total += projections[o, int(np.floor(y)), int(np.floor(x))]
        assert abs(value - total / len(frames)) < 1e-6
    assert mean_pixel(frames, projections, [[0, 0, 50.0]]) == 0  # no view sees it
