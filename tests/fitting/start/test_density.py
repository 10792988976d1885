"""The factor on starting densities that fits the projections."""

import numpy as np

from helpers.sphere import sphere_scan
from lingo_mi.fitting.start.density import least_squares_factor
from lingo_mi.fitting.start.masks import MaskStart
from lingo_mi.scan import Scan


def test_least_squares_factor_minimises():
    rng = np.random.default_rng(0)
    measured, rendered = rng.random((2, 4, 5)), rng.random((2, 4, 5))
    alpha = least_squares_factor(measured, rendered)
    best = ((measured - alpha * rendered) ** 2).sum()
    assert best < ((measured - (alpha + 1e-3) * rendered) ** 2).sum()
    assert best < ((measured - (alpha - 1e-3) * rendered) ** 2).sum()
    assert least_squares_factor(measured, 0 * rendered) == 1
    assert least_squares_factor(-measured, rendered) == 1


def test_the_factor_is_that_of_eight_views():
    geometry, frames, projections = sphere_scan(n=16)
    seen = []

    def render(points, density, spacing, views):
        seen.extend(views.tolist())
        return projections[views]

    MaskStart(n_points=300).from_views(Scan(geometry, projections), np.random.default_rng(0), render)
    assert seen == [0, 2, 4, 6, 8, 10, 12, 14]
