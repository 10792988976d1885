"""Motions of a scanner: the angles of a circle, the heights of a helix, and the rays of any motion in TIGRE's terms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import limits
from lingo_mi.geometry.rays import Rays

if TYPE_CHECKING:
    from typing_extensions import Unpack


def circular(n: int, total: float = 360.0, start: float = 0.0) -> np.ndarray:
    """Evenly spaced angles on a circle.

    Parameters
    ----------
    n : int
        Number of views, from 1 to `limits.MOST_VIEWS`.
    total, start : float
        The angles divide [start, start + total), in degrees. A negative total turns the other way.

    Returns
    -------
    ndarray
        [n] radians.

    Raises
    ------
    InputError
        For a number of views out of range, and for angles of too many turns.

    Examples
    --------
    >>> (circular(4) / np.pi).tolist()
    [0.0, 0.5, 1.0, 1.5]
    """
    count = limits.numbers('the number of views', n)
    if count.ndim or not count >= 1 or np.isfinite(count) and count % 1:
        raise InputError(f'a scan needs a whole number of views, at least one view, not {shown(n)}')
    if count > limits.MOST_VIEWS:
        raise InputError(f'a scan has at most {limits.MOST_VIEWS} views, not {shown(n)}')
    for name, degrees in (('start', start), ('total', total)):
        if limits.angles(name, np.radians(limits.lengths(name, degrees))).ndim:
            raise InputError(f'{name} must be one number of degrees, not {shown(degrees)}')
    return np.radians(float(start) + float(total) * np.arange(int(count)) / int(count))


def helix(angles: ArrayLike, pitch: float) -> np.ndarray:
    """Heights [n] in mm of a helix that climbs `pitch` mm a turn: 0 at the angle 0.

    Parameters
    ----------
    angles : array_like
        [n] radians, beyond 2 pi if there are several turns. Two turns around z = 0 have -2 pi to 2 pi.

    Examples
    --------
    >>> helix(circular(8, total=720, start=-360), pitch=40)   # -40, -30, ..., 30
    """
    climb = limits.lengths('pitch', pitch)
    if climb.ndim:
        raise InputError(f'pitch must be one number, in mm a turn, not {shown(pitch)}')
    return climb * limits.angles('angles', angles) / (2 * np.pi)


def spread(total: int, n: int) -> np.ndarray:
    """n indices evenly spaced over range(total), the first one 0: the views a sparse fit uses.

    Raises
    ------
    InputError
        Unless 1 <= n <= total.

    Examples
    --------
    >>> spread(100, 4)   # 0, 25, 50, 75
    """
    if not 1 <= n <= total:
        raise InputError(f'{n} views were asked for, but the scan has {total}')
    return np.arange(n) * total // n


def rotation(axis: str, angle: ArrayLike) -> np.ndarray:
    """Matrices [n, 3, 3] that turn by `angle` [n] (radians, right-handed) about 'x', 'y' or 'z'."""
    angle = np.atleast_1d(np.asarray(angle, float))
    i = 'xyz'.index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    out = np.zeros((len(angle), 3, 3))
    out[:, i, i] = 1
    out[:, j, j] = out[:, k, k] = np.cos(angle)
    out[:, k, j] = np.sin(angle)
    out[:, j, k] = -out[:, k, j]
    return out


class Motion(TypedDict, total=False):
    """Motions of a scanner's source and panel off the plain circle, once, or for every view with a first axis of n.

    All are 0 by default. Rotations are in TIGRE's order (`computeDeltas_Siddon` in its CUDA code). TIGRE writes
    `height` as a per-view `offOrigin`, and `tilt` as the second Euler angle with the opposite sign. rotDetector does not turn the
    beam of a parallel scan.

    Parameters
    ----------
    offDetector : array_like
        (v, u), mm: shift of the panel after its rotation, positive v up.
    rotDetector : array_like
        (roll, pitch, yaw), radians: the panel is turned by Rz(roll) Ry(pitch) Rx(yaw) about its centre, in the frame (towards the
        source, u, up). Roll turns it about the vertical, yaw in its own plane.
    COR : array_like
        Shift of source and panel along u, mm: minus the offset of the true axis of rotation.
    height : array_like
        Shift of source and panel along z, mm (a helix).
    tilt : array_like
        Radians by which the source is lifted out of the plane of rotation and the panel lowered (laminography).
    """

    offDetector: ArrayLike
    rotDetector: ArrayLike
    COR: ArrayLike
    height: ArrayLike
    tilt: ArrayLike


def scanner_rays(
    angles: ArrayLike, DSO: ArrayLike, DSD: ArrayLike, nDetector: tuple[int, int], dDetector: tuple[float, float],
    parallel: bool = False, **motion: Unpack[Motion],
) -> Rays:  # fmt: skip
    """The rays of a scanner's views in the world frame of `lingo_mi.geometry.base`, from TIGRE's numbers.

    Parameters
    ----------
    angles : array_like
        [n] radians, or [n, 3] Euler angles: the view is turned by Rz(a1) Ry(a2) Rz(a3).
    DSO, DSD : array_like
        Distances from the source to the axis and to the panel, mm; once or for every view.
    nDetector, dDetector
        Pixels and pixel size in mm, (v, u).
    motion : Unpack[Motion]
        See `Motion`.

    Raises
    ------
    InputError
        If an argument has neither one value nor one for every view.

    Examples
    --------
    >>> scanner_rays(circular(50), 1000, 1500, (384, 512), (0.8, 0.8), tilt=0.1)
    """
    moves: dict[str, Any] = dict(offDetector=(0, 0), rotDetector=(0, 0, 0), COR=0, height=0, tilt=0)
    for name in motion.keys() - moves.keys():
        raise TypeError(f'{name!r} is not a number of a scanner; what moves one is {", ".join(moves)}')
    moves |= motion
    angles = np.atleast_1d(limits.angles('angles', angles))
    n = len(angles)

    def each(name, value, *shape):
        value = (limits.angles if name in ('angles', 'tilt', 'rotDetector') else limits.lengths)(name, value)
        if value.shape not in (shape, (n, *shape)):
            raise InputError(
                f'{name} must be {" x ".join(map(str, shape)) or "one"} number{"s" * bool(shape)}, or that for '
                f'each of {n} views, not an array of shape {value.shape}'
            )
        return np.broadcast_to(value, (n, *shape))

    euler = angles if angles.ndim == 2 else np.stack([angles, np.zeros(n), np.zeros(n)], 1)
    euler = each('angles', euler, 3)
    DSO, DSD = each('DSO', DSO), each('DSD', DSD)
    COR, height, tilt = (each(name, moves[name]) for name in ('COR', 'height', 'tilt'))
    off = each('offDetector', moves['offDetector'], 2)
    roll, pitch, yaw = each('rotDetector', moves['rotDetector'], 3).T
    (dv, du), (nv, nu) = dDetector, nDetector

    # At the angle 0: the source on the x axis, u along y, rows down.
    turn = rotation('z', euler[:, 0]) @ rotation('y', euler[:, 1] - tilt) @ rotation('z', euler[:, 2])
    panel = turn @ rotation('z', roll) @ rotation('y', pitch) @ rotation('x', yaw)
    out, across, up = (turn[:, :, i] for i in range(3))
    u, v = panel[:, :, 1], -panel[:, :, 2]
    tangent = rotation('z', euler[:, 0])[:, :, 1]
    shift = COR[:, None] * tangent + height[:, None] * np.array([0.0, 0.0, 1.0])
    centre = (DSO - DSD)[:, None] * out + off[:, 1:] * across + off[:, :1] * up + shift
    corner = centre - nu / 2 * du * u - nv / 2 * dv * v
    source = -out if parallel else DSO[:, None] * out + shift
    return Rays(source, corner, du * u, dv * v, parallel)
