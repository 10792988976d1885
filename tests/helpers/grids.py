"""Helpers of tests of the grid projector."""

import drjit as dr
import mitsuba as mi
import numpy as np

from helpers.circles import circle
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.grid import scatter, view_table, view_walk, whole_box


def scan(mode='cone', n=4, **changes):
    settings = dict(
        DSO=200.0,
        DSD=300.0,
        nDetector=(17, 21),
        dDetector=(3.0, 2.6),
        nVoxel=(9, 11, 7),
        dVoxel=(4.0, 3.0, 5.0),
        angles=circular(n, start=11),
        mode=mode,
        offOrigin=(3.0, -2.0, 1.0),
        offDetector=(2.0, -4.0),
    )
    return circle(**{**settings, **changes})


def backproject(projections, geometry):
    """The transpose of `grid.project_volume`, view by view: float32 [x, y, z] in units of projections [view, v, u] times mm."""
    n_v, n_u = geometry.nDetector
    target = dr.zeros(mi.Float, int(np.prod(geometry.grid.shape)))
    for image, row in zip(np.asarray(projections, np.float32), view_table(geometry)):
        walk, length = view_walk(geometry, mi.Float(row), *whole_box(geometry.grid.shape))
        scatter(target, length * mi.Float(image.T.ravel()), geometry.grid.shape, walk)
        dr.eval(target)
    return target.numpy().reshape(geometry.grid.shape)
