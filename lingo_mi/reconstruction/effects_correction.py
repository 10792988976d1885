"""Line integrals from projections with effects, for voxel algorithms and initial clouds, which do not model effects."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lingo_mi.effects.detector import filled
from lingo_mi.effects.forward import Effects
from lingo_mi.projectors import cutoff
from lingo_mi.projectors.objects import GridInCube
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.scan import Scan
from lingo_mi.scene.simulate import render_objects, render_with

PASSES = 2  # of the scatter correction; more of them let FDK's own errors grow


def corrected(scan: Scan, effects: Effects, objects: Sequence, extent: float = cutoff.SIMULATE) -> Scan:
    """Correct line integrals by simulation, at the reference energy.

    Linearises the measured views, then subtracts the error that linearising leaves in simulated views of `objects`: blur,
    scatter and the second material (Joseph and Spital, J. Comput. Assist. Tomogr. 2, 1978).

    effects   whose noise is left out, so that simulated views are expected ones
    objects   similar to the scanned ones, as from `projectors.objects.find_objects`; Gaussians end at `extent` deviations
    """
    measured = _without_dead(scan, effects)
    effects = replace(effects, detector=effects.detector and effects.detector.expected)
    clean = render_objects(objects, scan.geometry, extent)
    seen = render_with(effects, objects, scan.geometry, np.arange(len(scan)), 0, extent)
    left = effects.linearised(Scan(scan.geometry, seen)).projections - clean
    linear = effects.linearised(measured)
    return replace(linear, projections=linear.projections - left)


def linearised(scan: Scan, effects: Effects) -> Scan:
    """`Effects.linearised`, with saturated pixels taken for air, and dead ones that the detector leaves in for their neighbours.

    With scatter, the result is then `corrected` with coarse FDK volumes of itself (Poludniowski et al., Phys. Med. Biol. 54,
    2009), in `PASSES` passes: the first volume still contains scatter, so its density is too low. A scan that FDK cannot
    reconstruct keeps its scatter, with a warning.
    """
    scan = _without_dead(scan, effects)
    found = effects.linearised(scan)
    if effects.detector and effects.detector.saturation:
        least = effects.detector.least(scan.geometry.nDetector)
        found = replace(found, projections=np.where(scan.projections <= least + 1e-6, np.float32(0), found.projections))
    if effects.scatter is None or effects.tube is None:  # one comes with the other
        return found
    if not can_rectify(scan):
        warnings.warn(
            'scatter stays in the projections for filtered backprojection and initial clouds: its estimate needs a '
            'source on a circle with its panel, and all pixels',
            stacklevel=2,
        )
        return found
    g = scan.geometry
    scatter = effects.scatter.within(g)
    effects = replace(effects.of_cloud(), scatter=scatter)
    shape = np.ceil(np.array(g.sVoxel) * scatter.voxels / max(g.sVoxel) - 1e-6).astype(int).clip(1).tolist()
    coarse = g.with_volume(shape, [s / n for s, n in zip(g.sVoxel, shape)])
    low = np.array(g.offOrigin) - np.array(g.sVoxel) / 2
    high = low + g.sVoxel
    for _ in range(PASSES):
        volume = np.maximum(FDK().run(Scan(coarse, found.projections)).volume, 0)
        found = corrected(scan, effects, [GridInCube.of(volume, low, high, 'volume')])
    return found


def _without_dead(scan: Scan, effects: Effects) -> Scan:
    """The scan with dead pixels that the detector leaves in as the means of their neighbours."""
    if not (effects.detector and effects.detector.dead) or effects.detector.corrected:
        return scan
    dead = effects.detector.maps(scan.geometry.nDetector)[1]
    return replace(scan, projections=np.stack([filled(view, dead) for view in scan.projections]).astype(np.float32))
