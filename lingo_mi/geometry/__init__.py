"""Scanner geometry in TIGRE's terms: NumPy only, no Mitsuba."""

from lingo_mi.geometry.base import Geometry, circular, helix, spread
from lingo_mi.geometry.rays import Rays, scanner_rays

__all__ = ['Geometry', 'Rays', 'circular', 'helix', 'scanner_rays', 'spread']
