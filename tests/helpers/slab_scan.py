"""A small scan for tests of slabs."""

import numpy as np

import lingo_mi as lm

SHAPE = 24, 20, 16


def slanted_scan():
    """A cone beam that meets the ends of the volume at a slant, with a box of unequal sides off the axis."""
    geometry = lm.Geometry.cone(
        DSO=300,
        DSD=450,
        nDetector=(40, 48),
        dDetector=4.0,
        nVoxel=SHAPE,
        dVoxel=(4.0, 5.0, 6.0),
        offOrigin=(3.0, -4.0, 5.0),
        angles=np.linspace(0, 6, 9),
    )
    return lm.simulate(np.random.default_rng(0).random(SHAPE, np.float32), geometry, progress=False).train
