"""The rays of flat-panel views, and scanners' motions in TIGRE's terms: pure NumPy, no Mitsuba.

`Rays` is what every projector knows of a scan: nothing in it says that a source moves on a circle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lingo_mi.errors import InputError


@dataclass(frozen=True)
class Rays:
    """The rays of n flat-panel views.

    The ray through the continuous pixel position (x, y), pixel centres at (i + 1/2, j + 1/2), is

        cone       from `source` along  corner + x u + y v - source
        parallel   from  corner + x u + y v  along `source`, which then holds the unit beam direction

    source, corner, u, v : float64 [n, 3]; corner is the outer corner of pixel (0, 0), u and v are one pixel long steps.
    """

    source: np.ndarray
    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    parallel: bool

    def __len__(self) -> int:
        return len(self.corner)

    def __getitem__(self, index) -> Rays:
        """The views selected by a slice or an integer array; one view stays [1, 3] when given as a list."""
        return Rays(self.source[index], self.corner[index], self.u[index], self.v[index], self.parallel)

    def centre(self, nDetector) -> np.ndarray:
        """The panels' centres [n, 3]; nDetector is (v, u) pixels."""
        return self.corner + nDetector[1] / 2 * self.u + nDetector[0] / 2 * self.v

    def moved(self, rotation=None, shift=None) -> Rays:
        """The views turned about the origin, then shifted: rotation [3, 3] or [n, 3, 3], shift [3] or [n, 3]."""
        rotation = np.eye(3) if rotation is None else np.asarray(rotation, float)
        shift = np.zeros(3) if shift is None else np.asarray(shift, float)
        source, corner, u, v = ((rotation @ x[..., None])[..., 0] for x in (self.source, self.corner, self.u, self.v))
        return Rays(source if self.parallel else source + shift, corner + shift, u, v, self.parallel)

    def joined(self, other: Rays) -> Rays:
        """These views, then the other's, of the same kind of beam."""
        if self.parallel != other.parallel:
            raise InputError('views of a parallel and of a cone beam cannot be one scan')
        return Rays(*(np.concatenate(pair) for pair in zip(self._arrays(), other._arrays())), self.parallel)

    def checked(self) -> Rays:
        """These views as float64 arrays, parallel beams of unit length.

        Raises InputError, naming the first bad view, where an array is not [n, 3] or not finite, where u and v span
        no panel, or where the rays run along it.
        """
        source, corner, u, v = (np.asarray(a, float) for a in self._arrays())
        if any(a.ndim != 2 or a.shape[1] != 3 or len(a) != len(corner) for a in (source, corner, u, v)) or not len(
            corner
        ):
            raise InputError(
                'source, corner, u and v of the poses must all be [view, 3], of at least one view, not '
                + ', '.join(str(list(a.shape)) for a in (source, corner, u, v))
            )
        for what, bad in _faults(source, corner, u, v, self.parallel):
            if bad.any():
                raise InputError(f'the pose of view {int(np.argmax(bad))} {what}')
        if self.parallel:
            source = source / np.linalg.norm(source, axis=1, keepdims=True)
        return Rays(source, corner, u, v, bool(self.parallel))

    def through(self, view: int, x, y):
        """Origins and (unnormalised) directions [..., 3] of the rays of one view at pixel positions x, y."""
        x, y = np.asarray(x, float)[..., None], np.asarray(y, float)[..., None]
        point = self.corner[view] + x * self.u[view] + y * self.v[view]
        if self.parallel:
            return point, np.broadcast_to(self.source[view], point.shape)
        return np.broadcast_to(self.source[view], point.shape), point - self.source[view]

    def project(self, points, view: int):
        """Continuous pixel positions (x, y) of `points` [N, 3], NaN where a point is not in front of the source."""
        points = np.asarray(points, float)
        a, b, c = self.u[view], self.v[view], self.corner[view]
        d = np.broadcast_to(self.source[view], points.shape) if self.parallel else points - self.source[view]
        start = points if self.parallel else self.source[view]
        # Solve  start + t d = c + x a + y b  by Cramer's rule.
        n = np.cross(a, b)
        along = d @ n
        with np.errstate(divide='ignore', invalid='ignore'):
            t = (c - start) @ n / along
            hit = start + t[:, None] * d - c
        if not self.parallel:
            hit[~(t > 0)] = np.nan
        nn = n @ n
        return np.cross(hit, b) @ n / nn, np.cross(a, hit) @ n / nn

    def _arrays(self):
        return self.source, self.corner, self.u, self.v


def _faults(source, corner, u, v, parallel):
    """What may be wrong with poses, each with the views [n] where it is; later ones count on the earlier."""
    yield 'holds NaN or infinity', ~np.isfinite(np.concatenate([source, corner, u, v], 1)).all(1)
    normal = np.cross(u, v)
    area = np.linalg.norm(normal, axis=1)
    steps = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
    yield 'has steps u and v that span no panel', ~(area > 1e-9 * steps)
    beam = source if parallel else corner - source
    length = np.linalg.norm(beam, axis=1)
    if parallel:
        yield 'has a beam of no direction', ~(length > 0)
    along = np.abs(np.sum(beam * normal, 1))
    yield (
        'has a beam along its panel' if parallel else 'has its source in the plane of its panel',
        ~(along > 1e-9 * np.maximum(length, np.sqrt(steps)) * area),
    )


def rotation(axis: str, angle) -> np.ndarray:
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


def scanner_rays(
    angles,
    DSO,
    DSD,
    nDetector,
    dDetector,
    parallel=False,
    offDetector=(0.0, 0.0),
    rotDetector=(0.0, 0.0, 0.0),
    COR=0.0,
    height=0.0,
    tilt=0.0,
) -> Rays:
    """The rays of a scanner's views in the world frame of `lingo_mi.geometry.base`, from TIGRE's numbers.

    Each argument but `parallel`, `nDetector` and `dDetector` may be given once or per view, with a first axis of n.

    angles       [n] radians, or [n, 3] Euler angles: the view is turned by Rz(a1) Ry(a2) Rz(a3)
    DSO, DSD     distances from the source to the axis and to the panel, mm
    nDetector, dDetector   pixels and pixel size in mm, (v, u)
    offDetector  (v, u), mm: shift of the panel, positive v up; after its rotation
    rotDetector  (roll, pitch, yaw), radians: the panel is turned by Rz(roll) Ry(pitch) Rx(yaw) about its centre, in the
                 frame (towards the source, u, up). Roll turns it about the vertical, yaw in its own plane
    COR          shift of source and panel along u, mm: minus the offset of the true axis of rotation
    height       shift of source and panel along z, mm (a helix)
    tilt         radians by which the source is lifted out of the plane of rotation, the panel sunk (laminography)

    The order of the rotations is that of TIGRE (`computeDeltas_Siddon` in its CUDA code), but for `height` and `tilt`,
    which TIGRE writes as a per-view `offOrigin` and as the second Euler angle, of opposite sign. The beam of a parallel
    scan is not turned by rotDetector. Raises InputError where an argument has neither one value nor one a view.
    """
    angles = np.asarray(angles, float)
    n = len(angles)

    def each(name, value, *shape):
        value = np.asarray(value, float)
        if value.shape not in (shape, (n, *shape)):
            raise InputError(
                f'{name} must be {" x ".join(map(str, shape)) or "one"} number{"s" * bool(shape)}, or that for '
                f'each of {n} views, not an array of shape {value.shape}'
            )
        return np.broadcast_to(value, (n, *shape))

    euler = angles if angles.ndim == 2 else np.stack([angles, np.zeros(n), np.zeros(n)], 1)
    euler = each('angles', euler, 3)
    DSO, DSD, COR = each('DSO', DSO), each('DSD', DSD), each('COR', COR)
    height, tilt = each('height', height), each('tilt', tilt)
    off = each('offDetector', offDetector, 2)
    roll, pitch, yaw = each('rotDetector', rotDetector, 3).T
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
