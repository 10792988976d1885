"""Scans of TIGRE for Python.

TIGRE's arrays are C-ordered and its names follow them: nVoxel, dVoxel, sVoxel and offOrigin are (z, y, x), nDetector, dDetector,
sDetector and offDetector (v, u), rotDetector turns about (x, y, z). TIGRE repeats DSO, DSD, offOrigin, offDetector, rotDetector
and COR for every view when it projects, so that each may hold one value or n. TIGRE, `Python/tigre/utilities/geometry.py` and
`cuda_interface/_types.pxd`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import limits
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.circle import CircularGeometry
from lingo_mi.geometry.grid import grid_of


def scan(geo: Any, angles: ArrayLike) -> Geometry:
    """The scan that a geometry of TIGRE for Python describes.

    TIGRE's rows run up, this package's down, and its volumes are [z, y, x]: `projections[:, ::-1]` and `volume.T` go with the
    result.

    Parameters
    ----------
    geo : tigre.geometry or dict
        An object or a dict with TIGRE's names, in TIGRE's order (z, y, x). Lengths are in mm. DSO, DSD, offOrigin, offDetector,
        rotDetector and COR hold once or for every view.
    angles : [n] or [n, 3]
        Radians, or Euler angles, as `tigre.Ax` takes them.

    Raises
    ------
    InputError
        If a number is missing, has neither one value nor one for every view, or makes no scan.

    Examples
    --------
    ::

        geo = tigre.geometry_default(high_resolution=False)
        scan = Scan(Geometry.from_tigre(geo, angles), tigre.Ax(image, geo, angles)[:, ::-1])
    """
    value_of = geo.get if isinstance(geo, Mapping) else lambda name: getattr(geo, name, None)
    angles = np.atleast_1d(limits.angles('angles', angles))
    if angles.ndim == 2 and angles.shape[1] == 3 and not angles[:, 1:].any():
        angles = angles[:, 0]  # what TIGRE makes of plain angles

    def each(name, length, default=None):
        """[length], a number if that is 1, or the same for every view if they differ."""
        value = default if value_of(name) is None else value_of(name)
        if value is None:
            raise InputError(f'the TIGRE geometry has no {name}')
        value = limits.lengths(name, value)
        if value.size not in (length, length * len(angles)):
            raise InputError(
                f'{name} of the TIGRE geometry must be {length} number{"s" * (length > 1)}, or that for each of '
                f'{len(angles)} views, not an array of shape {value.shape}'
            )
        value = value.reshape(-1, length)
        if (value == value[0]).all():
            value = value[0]
        return value[..., 0] if length == 1 else value

    def steps(kind, length):
        """The size of a pixel or voxel, which `s` says too."""
        if value_of('d' + kind) is not None:
            return each('d' + kind, length)
        count = each('n' + kind, length)
        if not np.all(count >= 1):
            raise InputError(f'n{kind} of the TIGRE geometry must be positive, not {shown(value_of("n" + kind))}')
        return each('s' + kind, length) / count

    mode = value_of('mode')
    if mode is None or isinstance(mode, str) and not mode:
        mode = 'cone'
    if not isinstance(mode, str):
        raise InputError(f"mode of the TIGRE geometry must be 'cone' or 'parallel', not {shown(mode)}")
    far = 0.0 if mode == 'parallel' else None  # in a parallel beam they only place the panel
    voxels: dict[str, Any] = dict(
        nVoxel=each('nVoxel', 3)[..., ::-1],
        dVoxel=steps('Voxel', 3)[..., ::-1],
        offOrigin=each('offOrigin', 3, np.zeros(3))[..., ::-1],
    )
    numbers: dict[str, Any] = dict(
        mode=mode,
        DSO=each('DSO', 1, far),
        DSD=each('DSD', 1, far),
        nDetector=each('nDetector', 2),
        dDetector=steps('Detector', 2),
        angles=angles,
        offDetector=each('offDetector', 2, np.zeros(2)),
    )
    # TIGRE's angles about x, y, z are this package's yaw, pitch and roll.
    motion: dict[str, Any] = dict(rotDetector=each('rotDetector', 3, np.zeros(3))[..., ::-1], COR=each('COR', 1, 0.0))
    plain = dict(DSO=0, DSD=0, offOrigin=1, offDetector=1, angles=1)  # dimensions of numbers that hold for all views
    moves = any(np.ndim((numbers | voxels)[name]) > n for name, n in plain.items())
    if moves or any(np.any(x) for x in motion.values()):
        return Geometry.per_view(**numbers, **motion, **voxels)
    return CircularGeometry(**numbers, grid=grid_of(voxels))
