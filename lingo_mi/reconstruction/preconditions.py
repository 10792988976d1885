"""Requirements of voxel reconstruction on a scan."""

from __future__ import annotations

from itertools import product

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.scan import Scan, require_finite


def require_circle(scan: Scan, what: str) -> CircularGeometry:
    """The geometry of a scan on a circle before an upright panel, with every pixel valid.

    `rectify.can_rectify` also allows turned and tilted panels.

    Parameters
    ----------
    what : str
        The method that needs it, for the message.

    Raises
    ------
    InputError
        For any other.
    """
    if not isinstance(scan.geometry, CircularGeometry):
        raise InputError(f'{what} needs a source on a circle about z and an upright panel; this scan has other poses')
    require_pixels(scan, what)
    return scan.geometry


def require_pixels(scan: Scan, what: str) -> None:
    """Raises InputError if a pixel is invalid. what: the method that needs valid pixels, for the message."""
    if scan.valid is not None:
        raise InputError(f'{what} needs every pixel, and some of this scan are not valid: fill them first')


def require_rays(geometry: Geometry) -> None:
    """Raises InputError if a source is inside the volume, or if no ray of any view meets the volume."""
    rays, centre, half = geometry.rays(curved=True), np.array(geometry.grid.centre), np.array(geometry.grid.size) / 2
    if not rays.parallel and (np.abs(rays.source - centre) < half).all(1).any():
        raise InputError('the source lies within the volume: check DSO, nVoxel and dVoxel')
    corners, (rows, columns) = centre + half * list(product((-1, 1), repeat=3)), geometry.nDetector
    for view in range(len(geometry)):
        x, y = rays.project(corners, view)
        # NaN: corners behind the source, or beside a curved panel. The extent of the shadow is then unknown.
        if 0 < np.isnan(x).sum() < len(x) or x.max() > 0 and x.min() < columns and y.max() > 0 and y.min() < rows:
            return
    raise InputError('no ray meets the volume: check offOrigin, offDetector and the poses')


def require_signal(scan: Scan, purpose: str = 'reconstruct') -> None:
    """Raises InputError for projections that are empty or not finite. purpose: a verb, for the message."""
    if scan.stored is None:  # else what is read is checked
        require_finite(scan.projections)  # a scan is checked when it is made, but its array can be written to
    some = False
    for piece in scan.pieces():
        if piece.max() > 0:
            return
        some = some or bool(piece.any())
    if not some:
        raise InputError(f'the projections are zero everywhere: there is nothing to {purpose}')
    raise InputError(f'the projections are nowhere above zero: there is nothing to {purpose}; check their sign')
