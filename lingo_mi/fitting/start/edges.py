"""The start of `fast`: points on the edges of a quick reconstruction. NumPy and SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import ndimage

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.start.density import fitted_factor, sampled_density
from lingo_mi.fitting.start.number import NumberedStart
from lingo_mi.fitting.start.start import Render, StartingCloud, neighbour_distance
from lingo_mi.geometry.grid import Grid
from lingo_mi.lingo.voxel_filter import voxel_centres
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.sart import SART
from lingo_mi.scan import Scan

PASSES = 3  # of SART
LARGEST = 128  # voxels along the longest side of its volume: an edge is sought, not its shape
BLUR = 0.7  # standard deviation of the derivatives of a Gaussian that find edges, voxels
INSIDE = 0.02  # what density counts for beside its gradient per voxel, so that even regions get points, too
EMPTY = 0.01  # part of the largest density below which a voxel gets none


@dataclass(frozen=True)
class EdgeStart(NumberedStart):
    """Points drawn from the voxels of a volume of few passes of SART, by the size of its gradient.

    Gaussians are needed where density changes: even regions take few large ones. Densities are those of the volume at the
    points, times the factor that fits the projections best. Each point is jittered within its voxel. The scan may have any
    geometry.

    Parameters
    ----------
    n_points : int
        Voxels drawn without replacement, or all voxels that are not empty if these are fewer.
    """

    name: ClassVar = 'edges'

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        volume, half = run_algorithm(_coarse(scan), SART(niter=PASSES)).volume, scan.geometry.grid.half
        weight = ndimage.gaussian_gradient_magnitude(volume, BLUR, mode='nearest') + INSIDE * volume.clip(0)
        weight = np.where(volume < EMPTY * volume.max(), 0, weight.astype(float))
        total = weight.sum()
        if not total > 0:
            raise InputError("the projections give an empty volume: check the geometry and the volume's size")
        count = min(self.n_points, np.count_nonzero(weight))
        cells = rng.choice(volume.size, count, replace=False, p=(weight / total).ravel())
        size = 2 * np.asarray(half) / volume.shape
        points = voxel_centres(volume.shape, half, cells)
        points += rng.uniform(-0.5, 0.5, points.shape) * size * (np.array(volume.shape) > 1)
        density, spacing = sampled_density(volume, points, half), neighbour_distance(points, fallback=size.min())
        factor = fitted_factor(scan, render, points, density, spacing)
        return StartingCloud(points, density * factor, spacing, dict(method=self.name, density_factor=factor))


def _coarse(scan: Scan) -> Scan:
    """The scan with voxels and pixels so large that the volume has at most LARGEST voxels along its longest side."""
    g = scan.geometry
    factor = -(-max(g.grid.shape) // LARGEST)
    shape = [-(-n // factor) for n in g.grid.shape]
    voxels = [s / n for s, n in zip(g.grid.size, shape)]
    if scan.valid is None:  # else a block with one invalid pixel would be lost
        scan = scan.binned(factor)
    return scan.on(Grid(shape, voxels, scan.geometry.grid.centre))
