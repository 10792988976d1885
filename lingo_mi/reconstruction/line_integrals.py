"""Line integrals from projections with effects, for voxel algorithms and initial clouds, which do not model effects."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lingo_mi.effects.detector import filled
from lingo_mi.effects.forward import Effects, effects_of
from lingo_mi.projectors import cutoff
from lingo_mi.projectors.objects import GridInCube
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.scan import Scan
from lingo_mi.scene.simulate import render_objects, render_with

PASSES = 2  # of the scatter correction; more of them let FDK's own errors grow


def line_integrals(scan: Scan) -> Scan:
    """Remove a scan's effects from its projections, for algorithms that do not model effects.

    Beam hardening is inverted for a single material. Saturated pixels become air, and dead ones that the detector leaves in
    become the means of their neighbours. Blur stays. With scatter, the result is then `corrected` with coarse FDK volumes of
    itself (Poludniowski et al., Phys. Med. Biol. 54, 2009), in `PASSES` passes: the first volume still contains scatter, so
    its density is too low.

    Parameters
    ----------
    scan : Scan
        Projections [view, v, u], with or without effects.

    Returns
    -------
    Scan
        The same views as line integrals at the reference energy, with `effects=None`; a scan without effects as it is.

    Warns
    -----
    UserWarning
        If scatter stays in the projections, because FDK cannot reconstruct the scan.

    Examples
    --------
    >>> found = reconstruct(line_integrals(scan), SART(niter=5))
    """
    effects = effects_of(scan)
    if effects is None:
        return scan
    filled_in = _without_dead(scan, effects)
    projections = effects.without_hardening(filled_in)
    if effects.detector and effects.detector.saturation:
        least = effects.detector.least(scan.geometry.nDetector)
        projections = np.where(filled_in <= least + 1e-6, np.float32(0), projections)
    linear = replace(scan, projections=projections, effects=None)
    if effects.scatter is None or effects.tube is None:  # one comes with the other
        return linear
    if not can_rectify(scan):
        warnings.warn(
            'scatter stays in the projections for filtered backprojection and initial clouds: its estimate needs a '
            'source on a circle with its panel, and all pixels',
            stacklevel=2,
        )
        return linear
    g = scan.geometry
    scatter = effects.scatter.within(g)
    effects = replace(effects.of_cloud(), scatter=scatter)
    size = np.array(g.grid.size)
    coarse = g.on(g.grid.resized(np.ceil(size * scatter.voxels / max(size) - 1e-6).astype(int).clip(1)))
    low, high = g.grid.low, g.grid.low + size
    for _ in range(PASSES):
        volume = np.maximum(FDK()._run(Scan(coarse, linear.projections)).volume, 0)
        linear = corrected(scan, effects, [GridInCube.of(volume, low, high, 'volume')])
    return linear


def corrected(scan: Scan, effects: Effects, objects: Sequence, extent: float = cutoff.SIMULATE) -> Scan:
    """Correct line integrals by simulation, at the reference energy.

    Linearises the measured views, then subtracts the error that linearising leaves in simulated views of `objects`: blur,
    scatter and the second material (Joseph and Spital, J. Comput. Assist. Tomogr. 2, 1978).

    Parameters
    ----------
    effects : Effects
        Effects without their noise, so that simulated views are expected ones.
    objects : Sequence
        Similar to the scanned ones, as from `projectors.objects.find_objects`; Gaussians end at `extent` deviations.
    """
    measured = _without_dead(scan, effects)
    effects = replace(effects, detector=effects.detector and effects.detector.expected)
    clean = render_objects(objects, scan.geometry, extent)
    seen = render_with(effects, objects, scan.geometry, np.arange(len(scan)), 0, extent)
    left = effects.without_hardening(seen) - clean
    return replace(scan, projections=effects.without_hardening(measured) - left, effects=None)


def _without_dead(scan: Scan, effects: Effects) -> np.ndarray:
    """The projections with dead pixels that the detector leaves in as the means of their neighbours."""
    if not (effects.detector and effects.detector.dead) or effects.detector.corrected:
        return scan.projections
    dead = effects.detector.maps(scan.geometry.nDetector)[1]
    return np.stack([filled(view, dead) for view in scan.projections]).astype(np.float32)
