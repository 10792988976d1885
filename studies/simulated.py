"""A scan over a full turn, which the studies simulate."""

from __future__ import annotations

import numpy as np

from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.phantoms.x3d_scan import default_geometry
from lingo_mi.projectors import grid
from lingo_mi.validation.tables.objects import averaged, load_object
from lingo_mi.validation.tables.photons import LARGEST


def simulated(name: str, size: int, pixels: int, views: int, finer: int) -> tuple[Geometry, np.ndarray, np.ndarray]:
    """A cone-beam scan over a full turn of one of `tables.objects`: geometry, line integrals [view, v, u] up to LARGEST, and true
    volume.

    Parameters
    ----------
    size : int
        Voxels along the longest side.
    pixels : int
        Along the sides of the panel, which is twice as wide as the object.
    finer : int
        How many times as many voxels are scanned along each side.
    """
    phantom = load_object(name, size * finer)
    truth = averaged(phantom, size)
    geometry = default_geometry(phantom, circular(views), pixels)
    line_integrals = grid.project_volume(phantom.data, geometry)
    unit = np.float32(LARGEST / line_integrals.max())
    return geometry.on(truth.grid), line_integrals * unit, truth.data * unit
