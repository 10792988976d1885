"""The choice between the projectors of voxels."""

from __future__ import annotations

from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.grid_pair import GridPair
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.projectors.tilted_joseph import TiltedJoseph


def projector_class(geometry: Geometry) -> type[Joseph | TiltedJoseph | GridPair]:
    """The fastest projector that serves a scan: see docs/benchmarks/speed.md."""
    for kind in (Joseph, TiltedJoseph):
        if kind.serves(geometry):
            return kind
    return GridPair
