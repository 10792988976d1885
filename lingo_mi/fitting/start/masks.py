"""The start of LINGO, from projections alone (paper, sections III-A and III-B). NumPy and SciPy."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.fitting.start.density import fitted_factor, sampled_density
from lingo_mi.fitting.start.number import NumberedStart
from lingo_mi.fitting.start.start import Render, StartingCloud
from lingo_mi.lingo.density import mean_pixel
from lingo_mi.lingo.masks import Masks, masks, truncated
from lingo_mi.lingo.scaling import occupancy, scale_factor, scaled_grid
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.rectify import can_rectify
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan

# The paper sets the path length to 1, so that a pixel p = integral of sigma "is" sigma, and a point's mean pixel its density.
# True densities differ by a factor that depends on the object's size and on the overlap of the Gaussians.
FACTORS = {'paper': 1.0, 'r2': 0.15}


@dataclass(frozen=True)
class MaskStart(NumberedStart):
    """Otsu masks, voxel scaling, the intersection of all views, and the mean pixel for the density.

    Points of the high set are jittered by U(-1/2, 1/2) of a cell of the scaled grid. (The paper's equation, taken literally, has
    cells of the scanner's grid, which would leave points in clumps.) Points of the low set lie at the cell centres, except
    repeats, which are jittered, too: there may be fewer valid cells than points. An axis of one cell has no jitter. If the high
    set is empty, all points come from the low set. A point has its cell's density.

    Parameters
    ----------
    n_points : int
        Points of the cloud (paper, implementation details: 50,000).
    high_fraction : float
        Share of the points from the high-density set (paper, implementation details: 25 %).
    low_factor : float
        T_l = low_factor T_h (paper, section III-A: 0.1).
    occupancy_voxels : int
        V of the coarse grid for the occupancy (paper, section III-B: 16).
    V_S : float
        Upper bound of the voxel scaling (paper, section III-B: 20).
    misses : int
        Views that may miss a valid cell (paper: 0).
    outside : {'invalid', 'ignore', 'auto'}
        How to count a cell that projects outside a view's image; see `voxel_filter.valid_voxels`. 'invalid' is the paper's,
        'ignore' serves truncated scans, 'auto' is 'ignore' if the object reaches the edge of the panel in some view.
    density : {'lsq', 'paper', 'r2', 'fdk'}
        The factor on the mean pixel: 'paper' takes 1, 'r2' the 0.15 that R2-Gaussian puts on FDK densities, and 'lsq' the
        factor that fits the projections best. 'fdk' replaces the mean pixel by the density of an FDK volume at the point, and
        fits the factor as 'lsq' does. Scans that FDK cannot reconstruct get 'lsq' instead.

    Examples
    --------
    `lm.R2(start=lm.MaskStart(n_points=20_000))`
    """

    RANGES: ClassVar = NumberedStart.RANGES | dict(
        high_fraction=(0, 1), low_factor=(0, 1e6), occupancy_voxels=(1, 1e6), V_S=(0, 1e6), misses=(0, 1e6)
    )
    CHOICES: ClassVar = dict(outside=('invalid', 'ignore', 'auto'), density=(*FACTORS, 'lsq', 'fdk'))
    name: ClassVar = 'masks'

    high_fraction: float = 0.25
    low_factor: float = 0.1
    occupancy_voxels: int = 16
    V_S: float = 20.0
    misses: int = 0
    outside: str = 'invalid'
    density: str = 'lsq'

    def cloud(self, scan: Scan, rng: np.random.Generator, render: Render, unit: float) -> StartingCloud:
        if self.density != 'fdk':
            return self.from_views(scan, rng, render)
        if not can_rectify(scan):
            return replace(self, density='lsq').from_views(scan, rng, render)
        return self.from_views(scan, rng, render, run_algorithm(scan, FDK()).volume)

    def from_views(
        self, scan: Scan, rng: np.random.Generator, render: Render | None = None, fdk: np.ndarray | None = None
    ) -> StartingCloud:
        """Make the cloud from line integrals.

        Parameters
        ----------
        scan : Scan
            Line integrals.
        rng : Generator
            Generator of all random choices.
        render : callable, optional
            Renders a cloud of isotropic Gaussians; see `Render`. The densities 'lsq' and 'fdk' need it.
        fdk : ndarray, optional
            A volume [x, y, z], 1/mm, for the density 'fdk'.

        Returns
        -------
        StartingCloud
            In the normalised frame.

        Raises
        ------
        InputError
            If `render` or `fdk` is missing, and if no voxel lies in the masks of all views.
        """
        rays, shape, half = scan.geometry.normalised_rays(), scan.geometry.grid.shape, scan.geometry.grid.half
        projections, valid = np.asarray(scan.normalised, np.float32), scan.valid
        if self.density not in FACTORS and render is None:
            raise InputError(f"density '{self.density}' needs a render function: give one, or take 'paper' or 'r2'")
        if self.density == 'fdk' and fdk is None:
            raise InputError("density 'fdk' needs a reconstruction: give one, or take another density")

        image_masks = masks(projections, self.low_factor, valid)
        outside = _outside(self.outside, image_masks)
        P = occupancy(rays, image_masks, half, shape, self.occupancy_voxels, self.misses, outside)
        S = scale_factor(P, self.V_S)
        grid = scaled_grid(shape, S)
        low, high = valid_voxels(rays, image_masks, grid, half, self.misses, outside)
        if len(low) == 0:
            raise InputError(
                'no voxel lies in the low-density mask of every view: check the geometry and '
                "the volume's size, or, for a truncated scan, set outside='ignore' or misses > 0"
            )

        n_high = round(self.n_points * self.high_fraction) if len(high) else 0
        n_low = self.n_points - n_high
        cells, repeat = draw_cells(low, n_low, rng)
        jittered, repeats = repeat, np.count_nonzero(repeat)
        if n_high:
            more, again = draw_cells(high, n_high, rng)
            repeats += np.count_nonzero(again)
            cells, jittered = np.concatenate([more, cells]), np.concatenate([np.ones(n_high, bool), repeat])
        centres = voxel_centres(grid, half, cells)
        size = 2 * np.asarray(half, float) / grid
        jitter = rng.uniform(-0.5, 0.5, centres.shape) * (np.array(grid) > 1)
        points = np.where(jittered[:, None], centres + jitter * size, centres)

        if fdk is not None and self.density == 'fdk':
            density = sampled_density(fdk, points, half)
        else:
            unique, inverse = np.unique(cells, return_inverse=True)
            density = mean_pixel(rays, projections, voxel_centres(grid, half, unique), valid)[inverse]
        spacing = neighbour_distance(points, fallback=size.min())
        if render is not None and self.density not in FACTORS:
            factor = fitted_factor(scan, render, points, density, spacing)
        else:
            factor = FACTORS[self.density]
        info = {
            'method': self.name,
            'P': P,
            'S': S,
            'grid': grid,
            'density': self.density,
            'density_factor': factor,
            'cells_low': len(low),
            'cells_high': len(high),
            'points_low': n_low,
            'points_high': n_high,
            'repeats': int(repeats),
            'outside': outside,
            'T_high': float(image_masks.t_high.mean()),
            'T_low': float(image_masks.t_low.mean()),
        }
        return StartingCloud(points, density * factor, spacing, info)


def draw_cells(cells: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw `count` of the cells, without replacement while they last: (cells [count], whether each is a repeat [count]).

    If there are fewer cells than points, cells are repeated as evenly as possible.
    """
    rounds = [rng.permutation(cells) for _ in range(max(-(-count // len(cells)), 1))]
    return np.concatenate(rounds)[:count], np.arange(count) >= len(cells)


def _outside(wanted: str, image_masks: Masks) -> str:
    """The rule for cells outside an image ('invalid' or 'ignore'). Warns of truncated scans."""
    cut = truncated(image_masks)
    if not cut.any():
        return 'invalid' if wanted == 'auto' else wanted
    if wanted == 'invalid':
        warnings.warn(
            f'the object reaches the edge of the panel in {np.count_nonzero(cut)} of {len(cut)} views, and what a '
            'view does not see is taken for empty: for a truncated scan set outside=ignore',
            stacklevel=3,
        )
    return 'ignore' if wanted == 'auto' else wanted
