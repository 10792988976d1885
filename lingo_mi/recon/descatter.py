"""Scattered light taken out of projections, for what knows no scatter: filtered backprojection, initial clouds."""
from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from ..effects.forward import Effects
from ..effects.scatter import smoothed
from ..scan import Scan
from ..xray.frame import View
from ..xray.objects import GridInCube
from .circle import on_circle
from .fdk import fdk

PASSES = 2  # an object reconstructed with its scatter is too thin, so that the first estimate is too large
MOST = .95  # of a pixel's signal that is taken for scatter: what is left must have a logarithm


def linearised(scan: Scan, effects: Effects) -> Scan:
    """A scan's line integrals at the reference energy (`Effects.linearised`), without its scattered light where that is known.

    The light is estimated by the path tracer of the scan's effects from a coarse FDK volume of the projections, and again from
    one without that light (Poludniowski et al., Phys. Med. Biol. 54, 2009). A scan that FDK cannot reconstruct keeps its
    scatter, with a warning.
    """
    if effects.scatter is None:
        return effects.linearised(scan)
    if not on_circle(scan):
        warnings.warn('scatter stays in the projections for filtered backprojection and initial clouds: its estimate needs a '
                      'source on a circle and all pixels', stacklevel=2)
        return effects.linearised(scan)
    g = scan.geometry
    shape = np.ceil(np.array(g.sVoxel) * effects.scatter.voxels / max(g.sVoxel) - 1e-6).astype(int).clip(1).tolist()
    coarse = g.with_volume(shape, [s / n for s, n in zip(g.sVoxel, shape)])
    frames, corners = g.frames(), np.array(effects.scatter.within(g).box)
    tube = replace(effects.tube, material=effects.tube.fitted(), materials={})
    found = scan
    for _ in range(PASSES):
        volume = np.maximum(fdk(Scan(coarse, effects.linearised(found).projections)), 0)
        body = GridInCube.of(volume, *corners, 'volume')
        views = []
        for i, measured in enumerate(scan.projections):
            means = effects.scatter.estimate([body], tube, effects.response, View.of(frames, i, *g.nDetector), i)
            light = np.exp(-measured.astype(float))
            views.append(-np.log(light - np.minimum(smoothed(*means, *g.nDetector), MOST * light)))
        found = replace(scan, projections=np.stack(views))
    return effects.linearised(found)
