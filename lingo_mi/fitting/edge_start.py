"""The initial cloud of `fast` (own): points on the edges of a quick reconstruction. NumPy and SciPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import ndimage

from lingo_mi.common.errors import InputError
from lingo_mi.lingo.density import fitted_factor, sampled
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.lingo.voxel_filter import voxel_centres
from lingo_mi.metrics.ipsd import neighbour_distance
from lingo_mi.reconstruction.sart import SART
from lingo_mi.scan import Scan

PASSES = 3  # of SART
LARGEST = 128  # voxels along the longest side of its volume: an edge is sought, not its shape
BLUR = 0.7  # standard deviation of the derivatives of a Gaussian that find edges, voxels
INSIDE = 0.02  # what density counts for beside its gradient per voxel, so that even regions get points, too
EMPTY = 0.01  # part of the largest density below which a voxel gets none


def edge_start(scan: Scan, render: Callable[..., np.ndarray], n_points: int, rng: np.random.Generator) -> InitialCloud:
    """Points drawn from the voxels of a volume of few passes of SART, by the size of its gradient.

    scan       line integrals of n views, of any geometry
    render     as of `lingo.initialise`
    n_points   drawn without replacement; all voxels that are not empty if they are fewer. Each is jittered within its voxel
    rng        numpy Generator

    Gaussians are needed where density changes: even regions take few large ones. Densities are those of the volume at the points,
    times the factor that fits the projections best. Raises InputError for an empty volume.
    """
    volume, half = SART(niter=PASSES).run(_coarse(scan)).volume, scan.geometry.half
    weight = ndimage.gaussian_gradient_magnitude(volume, BLUR, mode='nearest') + INSIDE * volume.clip(0)
    weight = np.where(volume < EMPTY * volume.max(), 0, weight.astype(float))
    total = weight.sum()
    if not total > 0:
        raise InputError("the projections give an empty volume: check the geometry and the volume's size")
    count = min(n_points, np.count_nonzero(weight))
    cells = rng.choice(volume.size, count, replace=False, p=(weight / total).ravel())
    size = 2 * np.asarray(half) / volume.shape
    points = voxel_centres(volume.shape, half, cells)
    points += rng.uniform(-0.5, 0.5, points.shape) * size * (np.array(volume.shape) > 1)
    density, spacing = sampled(volume, points, half), neighbour_distance(points, fallback=size.min())
    factor = fitted_factor(scan, render, points, density, spacing)
    return InitialCloud(points, density * factor, spacing, dict(method='edges', density_factor=factor))


def _coarse(scan: Scan) -> Scan:
    """The scan with voxels and pixels so large that the volume has at most LARGEST voxels along its longest side."""
    g = scan.geometry
    factor = -(-max(g.nVoxel) // LARGEST)
    shape = [-(-n // factor) for n in g.nVoxel]
    voxels = [s / n for s, n in zip(g.sVoxel, shape)]
    if scan.valid is None:  # else a block with one invalid pixel would be lost
        scan = scan.binned(factor)
    return replace(scan, geometry=scan.geometry.with_volume(shape, voxels))
