"""The start of `fast`: points on the edges of a quick reconstruction, within LINGO's masks. NumPy and SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import ndimage

from lingo_mi.common.errors import InputError
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.start.density import fitted_factor, sampled_density
from lingo_mi.fitting.start.number import NumberedStart
from lingo_mi.fitting.start.start import Render, StartingCloud
from lingo_mi.geometry.grid import Grid
from lingo_mi.lingo.masks import masks, truncated
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.reconstruction.sart import SART
from lingo_mi.scan import Scan

PASSES = 3  # of SART
LARGEST = 128  # voxels along the longest side of its volume: an edge is sought, not its shape
BLUR = 0.7  # standard deviation, in voxels, of the Gaussian whose derivatives find edges
INSIDE = 0.02  # weight of the density beside its gradient per voxel, so that even regions get points, too
EMPTY = 0.01  # part of the largest density below which a voxel gets none
MOST_LOST = 0.1  # part of the edges that masks may cut off; masks that cut off more are wrong about the object


@dataclass(frozen=True)
class EdgeStart(NumberedStart):
    """Points drawn from the voxels of a volume of few passes of SART, by the size of its gradient.

    Gaussians are needed where density changes: even regions take few large ones. LINGO's masks decide where Gaussians may be: a
    voxel gets points only if it, or a voxel beside it, lies in the low masks of all views (paper, section III-A). The neighbours
    count because the filter tests voxel centres, and an edge runs through voxels whose centres lie outside. Densities are those
    of the volume at the points, times the factor that fits the projections best. Each point is jittered within its voxel. The
    scan may have any geometry.

    Parameters
    ----------
    n_points : int
        Voxels drawn without replacement, or all voxels that qualify if these are fewer.
    within : {'masks', 'volume'}
        Where points may lie: in LINGO's masks, or anywhere in the volume. Masks that would cut off more than a tenth of the
        volume's edges are not used, and the fit's `info` says so.

    Examples
    --------
    `lm.R2(start=lm.EdgeStart(within='volume'))`
    """

    CHOICES: ClassVar = dict(within=('masks', 'volume'))
    name: ClassVar = 'edges'

    within: str = 'masks'

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        volume, half = run_algorithm(_coarse(scan), SART(niter=PASSES)).volume, scan.geometry.grid.half
        weight = ndimage.gaussian_gradient_magnitude(volume, BLUR, mode='nearest') + INSIDE * volume.clip(0)
        weight = np.where(volume < EMPTY * volume.max(), 0, weight.astype(float))
        if not weight.sum() > 0:
            raise InputError("the projections give an empty volume: check the geometry and the volume's size")
        info: dict[str, Any] = dict(method=self.name)
        if self.within == 'masks':
            weight, about_masks = _masked(weight, scan)
            info |= about_masks
        count = min(self.n_points, np.count_nonzero(weight))
        cells = rng.choice(volume.size, count, replace=False, p=(weight / weight.sum()).ravel())
        size = 2 * np.asarray(half) / volume.shape
        points = voxel_centres(volume.shape, half, cells)
        points += rng.uniform(-0.5, 0.5, points.shape) * size * (np.array(volume.shape) > 1)
        density, spacing = sampled_density(volume, points, half), neighbour_distance(points, fallback=size.min())
        factor = fitted_factor(scan, render, points, density, spacing)
        return StartingCloud(points, density * factor, spacing, info | dict(density_factor=factor))


def _masked(weight: np.ndarray, scan: Scan) -> tuple[np.ndarray, dict[str, Any]]:
    """The weight of each voxel [x, y, z], zero outside the masks of all views, and what the masks are."""
    object_masks = masks(np.asarray(scan.normalised, np.float32), valid=scan.valid)
    outside = 'ignore' if truncated(object_masks).any() else 'invalid'
    low, _ = valid_voxels(
        scan.geometry.normalised_rays(), object_masks, weight.shape, scan.geometry.grid.half, outside=outside
    )
    inside = np.zeros(weight.shape, bool)
    inside.ravel()[low] = True
    masked = np.where(ndimage.maximum_filter(inside, 3), weight, 0)
    lost = 1 - masked.sum() / weight.sum()
    info = dict(
        T_high=float(object_masks.t_high.mean()),
        T_low=float(object_masks.t_low.mean()),
        grid=weight.shape,
        cells_low=len(low),
        edges_lost=float(lost),
        masks_used=bool(lost <= MOST_LOST),
    )
    return (masked if lost <= MOST_LOST else weight), info


def _coarse(scan: Scan) -> Scan:
    """The scan with voxels and pixels so large that the volume has at most LARGEST voxels along its longest side."""
    g = scan.geometry
    factor = -(-max(g.grid.shape) // LARGEST)
    shape = [-(-n // factor) for n in g.grid.shape]
    voxels = [s / n for s, n in zip(g.grid.size, shape)]
    if scan.valid is None:  # else a block with one invalid pixel would be lost
        scan = scan.binned(factor)
    return scan.on(Grid(shape, voxels, scan.geometry.grid.centre))
