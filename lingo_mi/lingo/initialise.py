"""LINGO's initial cloud (paper, section III-A and III-B), from projections alone. NumPy and SciPy."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import require_ranges
from lingo_mi.lingo.density import FACTORS, MODES, fitted_factor, mean_pixel, sampled
from lingo_mi.lingo.masks import masks, truncated
from lingo_mi.lingo.scaling import occupancy, scale_factor, scaled_grid
from lingo_mi.lingo.voxel_filter import valid_voxels, voxel_centres
from lingo_mi.metrics.ipsd import neighbour_distance
from lingo_mi.scan import Scan


@dataclass(frozen=True)
class InitialCloud:
    """The initial cloud of a fit, in the normalised frame.

    points   float64 [N, 3]
    density  float64 [N], value at the centre, in units of the volume's density; None for alpha compositing
    spacing  float64 [N], suggested standard deviation: rms distance to the three nearest neighbours
    info     data on the initialisation (numbers and strings only)
    """

    points: np.ndarray
    density: np.ndarray | None
    spacing: np.ndarray
    info: dict = field(default_factory=dict, compare=False)

    def __len__(self) -> int:
        return len(self.points)

    def denser(self, factor: float) -> InitialCloud:
        """The same cloud with densities times `factor`, where it knows any."""
        return replace(self, density=None if self.density is None else self.density * factor)


@dataclass(frozen=True)
class LingoSettings:
    """The parameters of the initialisation, each with its source.

    n_points           points of the cloud (paper, implementation details: 50k)
    high_fraction      share of the points from the high-density set (paper: 25 %)
    low_factor         T_l = low_factor T_h (section III-A: 0.1)
    occupancy_voxels   V of the coarse grid for the occupancy (section III-B: 16)
    V_S                upper bound of the voxel scaling (section III-B: 20)
    misses             views that may miss a valid cell (paper: 0)
    outside            'invalid' (paper) or 'ignore' for truncated scans, see `valid_voxels`; 'auto' is 'ignore' if the
                       object reaches the edge of the panel in some view (`masks.truncated`), else 'invalid'
    init_density       'lsq', 'paper', 'raw' or 'fdk', see `lingo_mi.lingo.density` (the paper gives no factor)

    Raises InputError for a value out of its range.
    """

    RANGES: ClassVar = dict(
        n_points=(1, 1e8),
        high_fraction=(0, 1),
        low_factor=(0, 1e6),
        occupancy_voxels=(1, 1e6),
        V_S=(0, 1e6),
        misses=(0, 1e6),
    )

    n_points: int = 50_000
    high_fraction: float = 0.25
    low_factor: float = 0.1
    occupancy_voxels: int = 16
    V_S: float = 20.0
    misses: int = 0
    outside: str = 'invalid'
    init_density: str = 'lsq'

    def __post_init__(self):
        require_ranges(self, **self.RANGES)
        if self.outside not in ('invalid', 'ignore', 'auto'):
            raise InputError(f"outside is 'invalid', 'ignore' or 'auto', not {self.outside!r}")
        if self.init_density not in MODES:
            raise InputError(f'init_density {self.init_density!r} is unknown: use one of {", ".join(MODES)}')


def draw(cells: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw `count` of the cells, without replacement while they last: (cells [count], whether each is a repeat [count]).

    If there are fewer cells than points, cells are repeated as evenly as possible.
    """
    rounds = [rng.permutation(cells) for _ in range(max(-(-count // len(cells)), 1))]
    return np.concatenate(rounds)[:count], np.arange(count) >= len(cells)


def _outside(wanted: str, found) -> str:
    """The rule for cells outside an image ('invalid' or 'ignore'). Warns of truncated scans."""
    cut = truncated(found)
    if not cut.any():
        return 'invalid' if wanted == 'auto' else wanted
    if wanted == 'invalid':
        warnings.warn(
            f'the object reaches the edge of the panel in {np.count_nonzero(cut)} of {len(cut)} views, and what a '
            'view does not see is taken for empty: for a truncated scan set outside=ignore',
            stacklevel=3,
        )
    return 'ignore' if wanted == 'auto' else wanted


def initialise(
    scan: Scan,
    settings: LingoSettings = LingoSettings(),
    rng: np.random.Generator | None = None,
    render: Callable[..., np.ndarray] | None = None,
    fdk: np.ndarray | None = None,
) -> InitialCloud:
    """The initial cloud of section III: masks, voxel scaling, intersection of all views, mean pixel.

    scan         line integrals of n views; a volume of a single slice (fan beam) is fine. Its voxels are the paper's V_d
    rng          numpy Generator (default: seed 0)
    render       for the init_density 'lsq' and 'fdk': render(points, density, spacing, views) -> projections [len(views), v, u]
                 of that cloud of isotropic Gaussians, for the view indices `views`
    fdk          for the init_density 'fdk': the reconstruction [x, y, z]

    Points of the high set are jittered by U(-1/2, 1/2) of a cell of the scaled grid (the paper's equation, taken literally, has
    cells of the scanner's grid, which would leave points in clumps). Points of the low set lie at the
    cell centres, except repeats, which are jittered too (there may be fewer valid cells than points). An axis of one
    cell has no jitter. If the high set is empty, all points come from the low set. A point has its cell's density.

    Raises InputError if no cell is valid, or if `render` or `fdk` is missing for the chosen `init_density`.
    """
    begun = time.perf_counter()
    rng = np.random.default_rng(0) if rng is None else rng
    rays, nVoxel, half = scan.geometry.normalised_rays(), scan.geometry.nVoxel, scan.geometry.half
    projections, valid = np.asarray(scan.normalised, np.float32), scan.valid
    if settings.init_density in ('lsq', 'fdk') and render is None:
        raise InputError(
            f"init_density '{settings.init_density}' needs a render function: give one, or choose 'paper' or 'raw'"
        )
    if settings.init_density == 'fdk' and fdk is None:
        raise InputError("init_density 'fdk' needs a reconstruction: give one, or choose another init_density")

    found = masks(projections, settings.low_factor, valid)
    outside = _outside(settings.outside, found)
    P = occupancy(rays, found, half, nVoxel, settings.occupancy_voxels, settings.misses, outside)
    S = scale_factor(P, settings.V_S)
    grid = scaled_grid(nVoxel, S)
    low, high = valid_voxels(rays, found, grid, half, settings.misses, outside)
    if len(low) == 0:
        raise InputError(
            'no voxel lies in the low-density mask of every view: check the geometry and '
            "the volume's size, or, for a truncated scan, set outside='ignore' or misses > 0"
        )

    n_high = round(settings.n_points * settings.high_fraction) if len(high) else 0
    n_low = settings.n_points - n_high
    cells, repeat = draw(low, n_low, rng)
    jittered, repeats = repeat, np.count_nonzero(repeat)
    if n_high:
        more, again = draw(high, n_high, rng)
        repeats += np.count_nonzero(again)
        cells, jittered = np.concatenate([more, cells]), np.concatenate([np.ones(n_high, bool), repeat])
    centres = voxel_centres(grid, half, cells)
    size = 2 * np.asarray(half, float) / grid
    jitter = rng.uniform(-0.5, 0.5, centres.shape) * (np.array(grid) > 1)
    points = np.where(jittered[:, None], centres + jitter * size, centres)

    if fdk is not None and settings.init_density == 'fdk':
        density = sampled(fdk, points, half)
    else:
        unique, inverse = np.unique(cells, return_inverse=True)
        density = mean_pixel(rays, projections, voxel_centres(grid, half, unique), valid)[inverse]
    spacing = neighbour_distance(points, fallback=size.min())
    if render is not None and settings.init_density in ('lsq', 'fdk'):
        factor = fitted_factor(scan, render, points, density, spacing)
    else:
        factor = FACTORS[settings.init_density]
    return InitialCloud(
        points,
        density * factor,
        spacing,
        {
            'method': 'lingo',
            'P': P,
            'S': S,
            'grid': grid,
            'density': settings.init_density,
            'density_factor': factor,
            'cells_low': len(low),
            'cells_high': len(high),
            'points_low': n_low,
            'points_high': n_high,
            'repeats': int(repeats),
            'outside': outside,
            'T_high': float(found.t_high.mean()),
            'seconds': time.perf_counter() - begun,
        },
    )
