"""Scans of phantoms on a circle, with air all around the object."""

import functools

import lingo_mi as lm
from lingo_mi.geometry import circular

PIXELS, SIZE = 96, 40


phantom = functools.lru_cache(functools.partial(lm.phantom, size=SIZE))


def scanned(name, mode='cone', views=25, total=360.0):
    """A scan of a phantom. Half the fan is about 12 degrees, and the panel is higher than the object."""
    made = phantom(name)
    side = max(made.spacing) * SIZE
    sizes = dict(nDetector=(110, PIXELS), nVoxel=SIZE, dVoxel=made.spacing, angles=circular(views, total))
    if mode == 'cone':
        geometry = lm.Geometry.cone(DSO=4 * side, DSD=6 * side, dDetector=side * 2.4 / PIXELS, **sizes)
    else:
        geometry = lm.Geometry.parallel(dDetector=side * 1.45 / PIXELS, **sizes)
    return lm.simulate(made, geometry, progress=False).train
