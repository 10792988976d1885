"""Peak memory of each algorithm, as measured by tests/reconstruction/test_recon_memory.py."""

from __future__ import annotations

from math import prod
from typing import NamedTuple

from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.reconstruction.rectify import rectified_geometry
from lingo_mi.reconstruction.wide_pixels import leave_voxels_out


class Need(NamedTuple):
    """volumes       peak of work on volumes, in volumes. One of them is the caller's: a start, or the truth
    wide_pixels   the same if rays leave voxels out
    projections   peak of work on projections, in sets of all projections
    """

    volumes: float
    wide_pixels: float
    projections: float


NEEDS = {  # by name of the algorithm
    'fdk': Need(3.4, 3.4, 1.5),
    'sart': Need(4.6, 8.7, 4.2),
    'os-sart': Need(3.7, 7.7, 4.8),
    'sirt': Need(3.7, 7.7, 6.3),
    'cgls': Need(5.7, 6.7, 5.3),
    'asd-pocs': Need(7.7, 8.7, 4.5),
    'pls': Need(15.5, 15.5, 5.5),  # and its prior's, `Algorithm.volumes`
    'refined': Need(10.8, 12.6, 4.6),
    'best': Need(15.2, 17.0, 8.5),
}


def memory_needed(algorithm: str, geometry: Geometry, views: int) -> float:
    """Peak memory of an algorithm of `NEEDS`, bytes: the larger of two peaks, of work on volumes (plus at most two sets of
    projections) and of work on projections (plus one volume). FDK has another set on the upright panel if the real one
    leans."""
    volume, projections = 4 * prod(geometry.grid.shape), 4 * views * prod(geometry.nDetector)
    need = NEEDS[algorithm]
    volumes = need.wide_pixels if leave_voxels_out(geometry) else need.volumes
    level = 0
    if algorithm == 'fdk' and not isinstance(geometry, CircularGeometry):
        level = 4 * views * prod(rectified_geometry(geometry, 'filtered backprojection').nDetector)
    sets = need.projections
    return max(volumes * volume + min(sets, 2) * projections, volume + sets * projections) + level
