"""TIGRE's geometry for Python as the numbers of `Geometry.per_view`.

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


def numbers(geo: Any, angles: ArrayLike) -> tuple[dict, bool]:
    """What `geo` says, in this package's order and by its names, with the angles; and whether a view leaves the circle.

    geo      an object or a dict with TIGRE's names, lengths in mm
    angles   [n] radians or [n, 3] Euler angles

    Raises InputError where a number is missing, or has neither one value nor one for every view.
    """
    given = geo.get if isinstance(geo, Mapping) else lambda name: getattr(geo, name, None)
    angles = np.atleast_1d(limits.angles('angles', angles))
    if angles.ndim == 2 and angles.shape[1] == 3 and not angles[:, 1:].any():
        angles = angles[:, 0]  # what TIGRE makes of plain angles

    def each(name, length, default=None):
        """[length], a number where that is 1, or the same for every view where they differ."""
        value = default if given(name) is None else given(name)
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
        if given('d' + kind) is not None:
            return each('d' + kind, length)
        count = each('n' + kind, length)
        if not np.all(count >= 1):
            raise InputError(f'n{kind} of the TIGRE geometry must be positive, not {shown(given("n" + kind))}')
        return each('s' + kind, length) / count

    mode = given('mode')
    if mode is None or isinstance(mode, str) and not mode:
        mode = 'cone'
    if not isinstance(mode, str):
        raise InputError(f"mode of the TIGRE geometry must be 'cone' or 'parallel', not {shown(mode)}")
    far = 0.0 if mode == 'parallel' else None  # of a parallel beam they only place the panel
    scan = dict(
        mode=mode,
        DSO=each('DSO', 1, far),
        DSD=each('DSD', 1, far),
        nDetector=each('nDetector', 2),
        dDetector=steps('Detector', 2),
        nVoxel=each('nVoxel', 3)[..., ::-1],
        dVoxel=steps('Voxel', 3)[..., ::-1],
        angles=angles,
        offOrigin=each('offOrigin', 3, np.zeros(3))[..., ::-1],
        offDetector=each('offDetector', 2, np.zeros(2)),
    )
    # TIGRE's angles about x, y, z are this package's yaw, pitch and roll.
    motion = dict(rotDetector=each('rotDetector', 3, np.zeros(3))[..., ::-1], COR=each('COR', 1, 0.0))
    plain = dict(DSO=0, DSD=0, offOrigin=1, offDetector=1, angles=1)  # dimensions of what no view changes
    moves = any(np.ndim(scan[name]) > n for name, n in plain.items()) or any(np.any(x) for x in motion.values())
    return scan | motion if moves else scan, moves
