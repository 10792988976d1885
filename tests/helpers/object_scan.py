"""Scans of phantoms on a circle, with air all around the object."""

import lingo_mi as lm
from lingo_mi.geometry import circular

PIXELS, SIZE = 96, 40


def scanned(name, mode='cone', views=25, total=360.0):
    """A view of 12 degrees half a fan; the panel is higher than the object."""
    phantom = lm.phantom(name, SIZE)
    side = max(phantom.spacing) * SIZE
    sizes = dict(nDetector=(110, PIXELS), nVoxel=SIZE, dVoxel=phantom.spacing, angles=circular(views, total))
    if mode == 'cone':
        geometry = lm.Geometry.cone(DSO=4 * side, DSD=6 * side, dDetector=side * 2.4 / PIXELS, **sizes)
    else:
        geometry = lm.Geometry.parallel(dDetector=side * 1.45 / PIXELS, **sizes)
    return lm.simulate(phantom, geometry, progress=False).train
