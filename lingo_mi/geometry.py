"""Scan geometry in TIGRE's terms: pure NumPy, no Mitsuba.

World frame, in mm: the rotation axis is z and passes through the origin, the volume's centre is `offOrigin`.
For the angle a (radians):

    source            DSO (cos a, sin a, 0)
    detector centre   (DSO - DSD) (cos a, sin a, 0) + offDetector[1] u + offDetector[0] z
    u (columns)       (-sin a, cos a, 0)
    v (rows)          (0, 0, -1)

Projections are stored [view, v, u], pixel centres at (i + 1/2) pixel steps. `offDetector` is TIGRE's (v, u): a positive
first entry lifts the panel towards +z, against the row order. Volumes are stored [x, y, z].

Normalised frame: the volume's longest side is scaled to 2 and its centre moved to the origin. Lengths and line
integrals are multiplied by `Geometry.scale` = 2 / max(sVoxel); densities keep their number.
"""
from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from .errors import InputError


@dataclass(frozen=True)
class Frames:
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

    def __getitem__(self, index) -> Frames:
        """The views selected by a slice or an integer array; one view stays [1, 3] when given as a list."""
        return Frames(self.source[index], self.corner[index], self.u[index], self.v[index], self.parallel)

    def rays(self, view: int, x, y):
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


@dataclass(frozen=True)
class Geometry:
    """A circular scan with a flat panel.

    mode                  'cone' or 'parallel'
    DSO, DSD              distances from the source to the axis and to the panel, mm
    nDetector, dDetector  pixels and pixel size, (v, u), mm
    nVoxel, dVoxel        voxels and voxel size, (x, y, z), mm
    angles                [n] radians
    offOrigin             centre of the volume, (x, y, z), mm
    offDetector           shift of the panel, (v, u), mm, positive v up
    """

    DSO: float
    DSD: float
    nDetector: tuple[int, int]
    dDetector: tuple[float, float]
    nVoxel: tuple[int, int, int]
    dVoxel: tuple[float, float, float]
    angles: np.ndarray = field(repr=False)
    mode: str = 'cone'
    offOrigin: tuple[float, float, float] = (0., 0., 0.)
    offDetector: tuple[float, float] = (0., 0.)

    def __post_init__(self):
        def fix(name, kind, length):
            value = np.atleast_1d(np.asarray(getattr(self, name), float)).ravel()
            if len(value) == 1:
                value = np.repeat(value, length)
            if len(value) != length or not np.all(np.isfinite(value)):
                raise InputError(f'{name} must be {length} finite numbers, not {getattr(self, name)!r}')
            object.__setattr__(self, name, tuple(kind(x) for x in value))

        if self.mode not in ('cone', 'parallel'):
            raise InputError(f"mode must be 'cone' or 'parallel', not {self.mode!r}")
        for name, kind, length in (('nDetector', int, 2), ('dDetector', float, 2), ('nVoxel', int, 3),
                                   ('dVoxel', float, 3), ('offOrigin', float, 3), ('offDetector', float, 2)):
            fix(name, kind, length)
        for name in ('nDetector', 'dDetector', 'nVoxel', 'dVoxel'):
            if min(getattr(self, name)) <= 0:
                raise InputError(f'{name} must be positive, not {getattr(self, name)}')
        angles = np.atleast_1d(np.asarray(self.angles, float))
        if angles.ndim != 1 or len(angles) == 0:
            raise InputError('the scan has no views: give at least one angle')
        if not np.all(np.isfinite(angles)):
            raise InputError('an angle of the scan is not a finite number')
        object.__setattr__(self, 'angles', angles)
        for name in ('DSO', 'DSD'):
            try:
                object.__setattr__(self, name, float(getattr(self, name)))
            except (TypeError, ValueError):
                raise InputError(f'{name} must be one number, in mm, not {getattr(self, name)!r}') from None
        if self.mode == 'cone' and not (np.isfinite(self.DSD) and self.DSD >= self.DSO > 0):
            raise InputError(f'a cone beam needs DSD >= DSO > 0, but DSO = {self.DSO:g} and DSD = {self.DSD:g} '
                             '(both are distances from the source, in mm)')

    def __len__(self) -> int:
        return len(self.angles)

    @property
    def sDetector(self):
        """Size of the panel, (v, u), mm."""
        return tuple(n * d for n, d in zip(self.nDetector, self.dDetector))

    @property
    def sVoxel(self):
        """Size of the volume, (x, y, z), mm."""
        return tuple(n * d for n, d in zip(self.nVoxel, self.dVoxel))

    @property
    def scale(self) -> float:
        """Factor from mm to normalised lengths."""
        return 2 / max(self.sVoxel)

    def subset(self, index) -> Geometry:
        """The same scan with the views `index` only."""
        return replace(self, angles=self.angles[index])

    def with_volume(self, nVoxel, dVoxel) -> Geometry:
        """The same scan with another voxel grid."""
        return replace(self, nVoxel=tuple(nVoxel), dVoxel=tuple(dVoxel))

    def frames(self) -> Frames:
        """The rays of all views in the world frame, mm."""
        c, s, zero = np.cos(self.angles), np.sin(self.angles), np.zeros(len(self))
        out = np.stack([c, s, zero], 1)
        u = np.stack([-s, c, zero], 1)
        v = np.broadcast_to([0., 0., -1.], out.shape)
        (dv, du), (nv, nu), (off_v, off_u) = self.dDetector, self.nDetector, self.offDetector
        centre = (self.DSO - self.DSD) * out + off_u * u - off_v * v
        corner = centre - nu / 2 * du * u - nv / 2 * dv * v
        source = -out if self.mode == 'parallel' else self.DSO * out
        return Frames(source, corner, du * u, dv * v, self.mode == 'parallel')

    def normalised_frames(self) -> Frames:
        """The rays of all views in the normalised frame, where the volume's longest side is [-1, 1]."""
        f, centre, k = self.frames(), np.array(self.offOrigin), self.scale
        source = f.source if f.parallel else (f.source - centre) * k
        return Frames(source, (f.corner - centre) * k, f.u * k, f.v * k, f.parallel)

    @property
    def half(self) -> np.ndarray:
        """Half the volume's sides in the normalised frame, [3]; the largest is 1."""
        return np.array(self.sVoxel) * self.scale / 2


def circular(n: int, total: float = 360., start: float = 0.) -> np.ndarray:
    """n angles (radians) evenly spaced over [start, start + total) degrees."""
    if n < 1:
        raise InputError(f'a scan needs at least one view, not {n}')
    return np.radians(start + total * np.arange(n) / n)


def spread(total: int, n: int) -> np.ndarray:
    """n indices evenly spaced over range(total), the first one 0: the views a sparse fit uses."""
    if not 1 <= n <= total:
        raise InputError(f'{n} views were asked for, but the scan has {total}')
    return np.arange(n) * total // n
