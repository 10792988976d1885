"""Rectification: resamples a scan with a turned, tilted, offset or curved panel to an upright flat one behind the same source.

The same rays cross both planes, so a homography maps positions on one to positions on the other (Hartley and Zisserman,
"Multiple View Geometry", 2nd edition, 2004, section 2.3); from the plane that a curved panel touches, `geometry.curve` goes on.
Line integrals stay the same; no weights are needed.
"""

from __future__ import annotations

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.circle import SAME, CircularGeometry
from lingo_mi.geometry.curved import CurvedGeometry
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import scanner_rays
from lingo_mi.reconstruction.arcs import gaps
from lingo_mi.reconstruction.preconditions import require_pixels
from lingo_mi.scan import Scan, interpolated

MOVES = 0.1  # share of its size by which the panel's shadow may move between views


def rectified(scan: Scan, what: str = 'an upright panel') -> Scan:
    """The scan on an upright panel, the same in all views: columns along z, rows along the source's circle.

    The geometry is `rectified_geometry`. Values are interpolated by cubic splines, and zero beyond half a pixel outside the real
    panel. A circular scan with an upright panel is returned unchanged.

    Parameters
    ----------
    scan : Scan
        All pixels valid; the source moves on a circle about z around the origin, and the panel with it.
    what : str
        The algorithm that needs such a panel, for messages.

    Raises
    ------
    InputError
        For invalid pixels, and for a source or a panel that moves otherwise.
    """
    require_pixels(scan, what)
    geometry, (n_v, n_u) = rectified_geometry(scan.geometry, what), scan.geometry.nDetector
    if geometry is scan.geometry:
        return scan
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in geometry.nDetector[::-1]))
    there = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    out = np.empty((len(scan), *geometry.nDetector), np.float32)
    real = scan.geometry.rays(curved=True)
    for view, to_real in enumerate(_homographies(geometry.rays(), real)):
        x, y, w = to_real @ there
        x, y = real.on_panel(x / w, y / w, view)
        # Half a pixel of margin: a single row that is slightly turned lies between two new rows.
        seen = (w > 0) & (x > -0.5) & (x < n_u + 0.5) & (y > -0.5) & (y < n_v + 0.5)
        value = interpolated(scan.projections[view], x, y)
        out[view] = np.where(seen, value, 0).reshape(geometry.nDetector)
    return Scan(geometry, out)


def can_rectify(scan: Scan) -> bool:
    """Return whether `rectified` accepts the scan: all pixels valid, the source on a circle, the panel moving with it."""
    try:
        require_pixels(scan, '')
        rectified_geometry(scan.geometry)
    except InputError:
        return False
    return True


def rectified_geometry(geometry: Geometry, what: str = 'an upright panel') -> CircularGeometry:
    """The geometry of an upright panel that contains the real panel's shadow in all views, with pixels no coarser.

    Of a curved panel these are the rows that are seen from side to side, with pixels as fine as in its middle.

    With an offset panel on a closed circle, the new panel is cut on the short side where its last row begins to see, because
    `fdk.ray_weights` treats all rows alike. Otherwise, on a closed circle, it is symmetric.

    Raises
    ------
    InputError
        If the source leaves a circle about z, or if the panel moves relative to the source by more than a tenth of its size, is
        turned too far for any line along the circle to cross it, or lies partly behind the source.
    """
    if isinstance(geometry, CircularGeometry):
        return geometry
    if isinstance(geometry, CurvedGeometry):
        geometry = geometry.to_flat()
        if isinstance(geometry, CircularGeometry):
            return geometry
    rays, (n_v, n_u) = geometry.rays(), geometry.nDetector
    DSO, DSD, angles = _circle(geometry, what)
    # Positions on this plane: mm from the central ray, along the circle and downwards.
    plane = scanner_rays(angles, DSO, DSD, (0, 0), (1.0, 1.0), rays.parallel)
    corners = np.array([[0, n_u, 0, n_u], [0, 0, n_v, n_v], [1, 1, 1, 1]], float)
    shadow = _homographies(rays, plane) @ corners
    if shadow[:, 2].min() <= 0:
        raise InputError(f'{what} needs a panel behind the axis; a part of this one is beside the source')
    shadow /= shadow[:, 2:]
    typical = np.median(shadow, 0)
    if np.any(np.abs(shadow - typical)[:, :2] > MOVES * np.ptp(typical[:2], 1)[:, None]):
        raise InputError(f'{what} needs a panel that keeps its place behind the source; this scan has other poses')
    (left, inner_left, inner_right, right), (top, inner_top, inner_bottom, bottom) = _ends(shadow)
    if inner_top >= inner_bottom:
        raise InputError(
            f'{what} needs a panel that sees some line along the circle from end to end; this one is turned '
            'too far in its plane'
        )
    if len(geometry) > 1 and not gaps(geometry.angles, 2 * np.pi)[2]:
        if inner_right > -left:
            left = inner_left
        elif -inner_left > right:
            right = inner_right
        else:
            right = max(right, -left)
            left = -right
    step_u, step_v = _steps(_homographies(plane, rays), shadow)
    rows, columns = (int(np.ceil(x - 1e-6)) for x in ((bottom - top) / step_v, (right - left) / step_u))
    return CircularGeometry(
        DSO=DSO,
        DSD=DSD,
        nDetector=(rows, columns),
        dDetector=(step_v, step_u),
        angles=angles,
        mode=geometry.mode,
        offDetector=(-(top + bottom) / 2, (left + right) / 2),
        grid=geometry.grid,
    )


def _circle(geometry: Geometry, what: str):
    """DSO, mean DSD and angles [view] of the source's circle about z. Raises InputError if there is no such circle."""
    rays = geometry.rays()
    out = -rays.source if rays.parallel else rays.source
    angles = np.arctan2(out[:, 1], out[:, 0])
    DSO = 0.0 if rays.parallel else float(np.linalg.norm(out[:, :2], axis=1).mean())
    depth = -np.sum(rays.centre(geometry.nDetector)[:, :2] * np.stack([np.cos(angles), np.sin(angles)], 1), 1)
    DSD = DSO + max(float(depth.mean()), 0.0)
    source = scanner_rays(angles, DSO, DSD, (0, 0), (1.0, 1.0), rays.parallel).source
    reach = np.linalg.norm(rays.corner, axis=1).max() if rays.parallel else 1.0
    if np.abs(source - rays.source).max() * reach > SAME * min(geometry.dDetector):
        raise InputError(f'{what} needs a source on a circle about z; this scan has other poses')
    return DSO, DSD, angles


def _ends(shadow):
    """Extents of a shadow [view, 3, corner], for each axis: outer and inner end on one side, inner and outer on the other."""
    across, down = np.abs(shadow[:, :2, 1:3] - shadow[:, :2, :1]).mean(0).T
    if across[0] < down[0]:  # a panel on its side: its columns lie along the circle
        shadow = shadow[:, :, [0, 2, 1, 3]]
    for edges in (shadow[:, 0, [0, 2]], shadow[:, 0, [1, 3]]), (shadow[:, 1, [0, 1]], shadow[:, 1, [2, 3]]):
        low, high = sorted(edges, key=np.mean)
        yield low.min(), low.max(), high.min(), high.max()


def _homographies(of: Rays, on: Rays) -> np.ndarray:
    """Homographies [view, 3, 3] from positions (x, y, 1) on one panel to (x w, y w, w) on another, along the same rays.

    w is positive in front of the source.
    """
    points = np.zeros((len(of), 4, 3))
    points[:, :3] = np.stack([of.u, of.v, of.corner], 2)
    points[:, 3, 2] = 1
    return camera_matrices(on) @ points


def _steps(to_pixels, at) -> np.ndarray:
    """Pixel sizes along both axes of a plane, [2], no larger than a pixel of any view there.

    Parameters
    ----------
    to_pixels
        Homographies [view, 3, 3] from the plane.
    at
        Positions [view, 3, corner] where they are compared.
    """
    x = to_pixels @ at
    # d(x / w) = (dx - (x / w) dw) / w
    slope = (to_pixels[:, :2, :2, None] - x[:, :2, None] / x[:, 2:, None] * to_pixels[:, 2:, :2, None]) / x[:, 2:, None]
    return 1 / np.linalg.norm(slope, axis=1).max((0, 2))
