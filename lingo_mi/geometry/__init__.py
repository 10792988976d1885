"""Rays and voxels of a scan: scanners in TIGRE's terms, poses, and the conventions of other packages. Needs no Mitsuba."""

from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.circle import CircularGeometry
from lingo_mi.geometry.curved import CurvedGeometry
from lingo_mi.geometry.grid import Grid
from lingo_mi.geometry.posed import PosedGeometry
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import circular, helix, scanner_rays, spread

__all__ = [
    'CircularGeometry',
    'CurvedGeometry',
    'Geometry',
    'Grid',
    'PosedGeometry',
    'Rays',
    'camera_matrices',
    'circular',
    'helix',
    'scanner_rays',
    'spread',
]
