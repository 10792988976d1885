"""Checks before a scan is simulated or read."""

from __future__ import annotations

import math
import warnings

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import room
from lingo_mi.geometry.base import Geometry


def check_memory(*geometries: Geometry | None, views: int = 0, needed: float = 0) -> None:
    """Raises InputError, before anything is allocated, for a scan that does not fit into this process's memory.

    Parameters
    ----------
    views : int
        Views of all geometries together (0: the views that they have).
    needed : float
        Peak memory of an algorithm, bytes (0: the least, see `least_memory`).
    """
    present = [g for g in geometries if g is not None]
    views = views or sum(map(len, present))
    needed = needed or least_memory(present[0], views)
    if needed > (has := room()):
        size = [' x '.join(map(str, counts)) for counts in (present[0].grid.shape, present[0].nDetector)]
        raise InputError(
            f'{size[0]} voxels and {views} views of {size[1]} pixels need at least {needed / 2**30:,.1f} GiB of '
            f'memory, but this process may take {has / 2**30:,.1f} GiB: lower nVoxel, nDetector or the views'
        )


def least_memory(geometry: Geometry, views: int) -> int:
    """Bytes of the least that work on a scan needs: the volume as read, fitted and compared, and the projections as measured and
    rendered."""
    return 4 * (3 * math.prod(geometry.grid.shape) + 2 * views * math.prod(geometry.nDetector))


def thinned(geometry: Geometry, slab: int) -> Geometry:
    """A scan with the slices of its volume that are in memory at once, about `slab` of them (0: all)."""
    return geometry.on(geometry.grid.slab(0, min(slab, geometry.grid.shape[2]))) if slab else geometry


def require_densities(volume: np.ndarray) -> None:
    """Raises InputError for a volume [x, y, z] that is hardly one of densities per mm: with a value of -500 or less, as
    Hounsfield units of air have, or below minus half the maximum.

    Smaller negative values may be undershoots of a reconstruction, and pass.
    """
    low, high = float(volume.min()), float(volume.max())
    if low <= -500 or low < -0.5 * high:
        raise InputError(
            f'the volume holds values from {low:g} to {high:g}, but densities per mm are not negative: convert Hounsfield '
            'units by numpy.maximum(mu_water * (1 + HU / 1000), 0), where mu_water, of water, is 0.0206 per mm at 60 keV'
        )


def warn_if_truncated(geometry: Geometry) -> None:
    """Warn if the volume's midplane is wider than the panels' field of view."""
    rays, centre = geometry.rays(curved=True), np.array(geometry.grid.centre)
    widest, columns = max(geometry.grid.size[:2]), geometry.nDetector[1]
    cut = 0
    for view in range(len(rays)):
        across = rays.u[view] / np.linalg.norm(rays.u[view]) * widest / 2
        x, _ = rays.project(np.stack([centre - across, centre + across]), view)
        cut += not (x.min() >= -1e-4 * columns and x.max() <= columns * (1 + 1e-4))  # also where it is NaN
    if cut:
        warnings.warn(
            f'the volume is {widest:g} mm wide, and the panel does not see all of it in {cut} of {len(rays)} '
            'views: projections may be truncated',
            stacklevel=2,
        )
