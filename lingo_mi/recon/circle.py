"""What reconstruction on voxels asks of a scan."""
from __future__ import annotations

from ..errors import InputError
from ..scan import Scan


def on_circle(scan: Scan) -> bool:
    """Whether the source moves on a circle about z before an upright panel, and every pixel is valid."""
    return scan.geometry.poses is None and scan.valid is None


def require_circle(scan: Scan, what: str):
    """Raises InputError, naming what needs it, for a scan that is not `on_circle`."""
    if scan.geometry.poses is not None:
        raise InputError(f'{what} needs a source on a circle about z and an upright panel; this scan has other poses')
    if scan.valid is not None:
        raise InputError(f'{what} needs every pixel, and some of this scan are not valid: fill them first')
