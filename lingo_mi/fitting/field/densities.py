"""A scan's densities as a neural field needs them: a bound, which is its unit, and a mean, which is its start."""

from __future__ import annotations

import numpy as np

from lingo_mi.projectors import grid
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan

SHARE, ROOM = 0.9999, 1.5  # part of an FDK volume's voxels below some density; the bound over that density
THINNEST = 0.1  # way through the densest matter, in halves of the volume's longest side, if there is no FDK volume
VIEWS = 8  # most views that a mean is taken over


def largest_density(scan: Scan) -> float:
    """A bound of a scan's densities, 1/mm: 1.5 times what an FDK volume exceeds in one voxel of 10,000.

    NAF is given volumes with densities from 0 to 1. With 5 to 25 views of the phantoms and test volumes the bound is 1.2 to 2.5
    times the largest true density. If FDK cannot reconstruct the scan, it is ten times the largest line integral over half the
    volume's longest side.

    Raises
    ------
    InputError
        For an empty scan.
    """
    require_signal(scan, 'fit')
    rough = float(scan.projections.max()) * scan.geometry.grid.scale / THINNEST
    if not can_rectify(scan):
        return rough
    density = ROOM * float(np.quantile(run_algorithm(scan, FDK()).volume, SHARE))
    # Three digits, so that a fit that goes on has the same unit, whatever the rounding of a reconstruction made anew.
    return float(f'{density:.3g}') if density > 0 else rough


def mean_density(scan: Scan) -> float:
    """The mean of a scan's densities along its rays through the volume, 1/mm.

    The sum of the line integrals over the sum of the path lengths, for the valid pixels of a few evenly spaced views. It is 0 if
    no ray meets the volume.
    """
    few = scan.subset(np.arange(min(len(scan), VIEWS)) * len(scan) // min(len(scan), VIEWS))
    ways = grid.project_volume(np.ones(few.geometry.grid.shape, np.float32), few.geometry).astype(float)
    inside = ways > 0 if few.valid is None else (ways > 0) & few.valid
    return float(few.projections[inside].sum(dtype=float) / ways[inside].sum()) if inside.any() else 0.0
