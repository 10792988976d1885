"""Scan geometry in TIGRE's terms: pure NumPy, no Mitsuba.

World frame, in mm: the rotation axis is z and passes through the origin, the volume's centre is `offOrigin`.
For the angle a (radians):

    source            DSO (cos a, sin a, 0)
    detector centre   (DSO - DSD) (cos a, sin a, 0) + offDetector[1] u + offDetector[0] z
    u (columns)       (-sin a, cos a, 0)
    v (rows)          (0, 0, -1)

Projections are stored [view, v, u], pixel centres at (i + 1/2) pixel steps. `offDetector` is TIGRE's (v, u): a positive
first entry lifts the panel towards +z, against the row order. Volumes are stored [x, y, z].

That is the circle. Any other motion is a pose for every view: `Geometry.per_view` makes them from TIGRE's numbers (helix,
tilt, turned or moving panels), `Geometry.posed` takes them as they are (`lingo_mi.files.poses` reads RTK's, ASTRA's and
projection matrices). Whatever projects asks `rays()`.

Normalised frame: the volume's longest side is scaled to 2 and its centre moved to the origin. Lengths and line
integrals are multiplied by `Geometry.scale` = 2 / max(sVoxel); densities keep their number.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.geometry.rays import Rays, scanner_rays

SAME = 1e-3  # pixels by which a pose may miss a circle and still be one


@dataclass(frozen=True)
class Geometry:
    """A scan with a flat panel: on a circle, or with a pose for every view.

    mode                  'cone' or 'parallel'
    DSO, DSD              distances from the source to the axis and to the panel, mm
    nDetector, dDetector  pixels and pixel size, (v, u), mm
    nVoxel, dVoxel        voxels and voxel size, (x, y, z), mm
    angles                [n] radians
    offOrigin             centre of the volume, (x, y, z), mm
    offDetector           shift of the panel, (v, u), mm, positive v up
    poses                 rays of every view, mm, where they are not those of the circle. They alone count then: DSO, DSD,
                          dDetector, offDetector and angles are nominal, for labels (see `posed`)
    """

    DSO: float
    DSD: float
    nDetector: tuple[int, int]
    dDetector: tuple[float, float]
    nVoxel: tuple[int, int, int]
    dVoxel: tuple[float, float, float]
    angles: np.ndarray = field(repr=False)
    mode: str = 'cone'
    offOrigin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offDetector: tuple[float, float] = (0.0, 0.0)
    poses: Rays | None = field(default=None, repr=False)

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
        for name, kind, length in (
            ('nDetector', int, 2),
            ('dDetector', float, 2),
            ('nVoxel', int, 3),
            ('dVoxel', float, 3),
            ('offOrigin', float, 3),
            ('offDetector', float, 2),
        ):
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
        if self.poses is not None:
            object.__setattr__(self, 'poses', self.poses.checked())
            if len(self.poses) != len(angles) or self.poses.parallel != (self.mode == 'parallel'):
                raise InputError(
                    f'{len(angles)} angles of a {self.mode} beam contradict {len(self.poses)} poses of a '
                    f'{"parallel" if self.poses.parallel else "cone"} beam'
                )
        elif self.mode == 'cone' and not (np.isfinite(self.DSD) and self.DSD >= self.DSO > 0):
            raise InputError(
                f'a cone beam needs DSD >= DSO > 0, but DSO = {self.DSO:g} and DSD = {self.DSD:g} '
                '(both are distances from the source, in mm)'
            )

    @classmethod
    def posed(cls, frames: Rays, nDetector, nVoxel, dVoxel, offOrigin=(0.0, 0.0, 0.0)) -> Geometry:
        """A scan with a given pose for every view.

        frames      in mm
        nDetector   (v, u) pixels; the other arguments as for the class

        Poses that are a circle's to a thousandth of a pixel (the source around z, the panel upright, rows down) give the
        plain geometry of that circle, which every file format knows. Otherwise the nominal DSO is the mean distance from
        the source to the volume's centre, DSD that to the panel's plane, dDetector the mean length of the steps, `angles`
        the directions to the source as seen from above. Raises InputError for poses that are none, see `Rays.checked`.
        """
        frames = frames.checked()
        nDetector = tuple(int(n) for n in nDetector)
        toward = -frames.source if frames.parallel else frames.source - np.asarray(offOrigin, float)
        normal = np.cross(frames.u, frames.v)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        angles = np.arctan2(toward[:, 1], toward[:, 0])
        if frames.parallel:
            DSO, DSD = 0.0, float(np.mean(np.abs(np.sum(frames.corner * normal, 1))))
        else:
            DSO = float(np.mean(np.linalg.norm(toward, axis=1)))
            DSD = float(np.mean(np.abs(np.sum((frames.corner - frames.source) * normal, 1))))
        step = tuple(float(np.mean(np.linalg.norm(x, axis=1))) for x in (frames.v, frames.u))
        more = dict(nVoxel=nVoxel, dVoxel=dVoxel, offOrigin=offOrigin, mode='parallel' if frames.parallel else 'cone')
        circle = _circle(frames, nDetector)
        if circle is not None:
            return cls(**circle, nDetector=nDetector, **more)
        return cls(DSO=DSO, DSD=DSD, nDetector=nDetector, dDetector=step, angles=angles, poses=frames, **more)

    @classmethod
    def per_view(
        cls, *, DSO, DSD, nDetector, dDetector, nVoxel, dVoxel, angles, mode='cone', offOrigin=(0.0, 0.0, 0.0), **motion
    ) -> Geometry:
        """A scan whose numbers may change from view to view, in TIGRE's terms.

        DSO, DSD    mm, one number or [n]
        angles      [n] radians or [n, 3] Euler angles
        offOrigin   (x, y, z) mm; or [n, 3], TIGRE's way to move the object: the grid then stays at their mean, and the
                    scanner moves by what is left, the other way round
        motion      offDetector, rotDetector, COR, height, tilt: see `frames.scanner_rays`

        Raises InputError for numbers that make no scan.
        """
        if mode not in ('cone', 'parallel'):
            raise InputError(f"mode must be 'cone' or 'parallel', not {mode!r}")
        panel = cls(1.0, 1.0, nDetector, dDetector, nVoxel, dVoxel, [0.0])  # one number may stand for both
        frames = scanner_rays(angles, DSO, DSD, panel.nDetector, panel.dDetector, mode == 'parallel', **motion)
        if mode == 'cone' and not (np.all(np.asarray(DSO) > 0) and np.all(np.asarray(DSD) >= np.asarray(DSO))):
            raise InputError(
                'a cone beam needs DSD >= DSO > 0 in every view (both are distances from the source, in mm)'
            )
        origin = np.asarray(offOrigin, float)
        if origin.ndim == 2:
            if origin.shape != (len(frames), 3):
                raise InputError(
                    f'offOrigin must be 3 numbers, or that for each of {len(frames)} views, not an array of '
                    f'shape {origin.shape}'
                )
            mean = origin.mean(0)
            frames, origin = frames.moved(shift=mean - origin), mean
        return cls.posed(frames, panel.nDetector, nVoxel, dVoxel, origin)

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
        return replace(self, angles=self.angles[index], poses=None if self.poses is None else self.poses[index])

    def joined(self, other: Geometry) -> Geometry:
        """The views of this scan, then those of another by the same scanner on the same grid."""
        poses = None
        if self.poses is not None or other.poses is not None:
            poses = self.rays().joined(other.rays())
        return replace(self, angles=np.concatenate([self.angles, other.angles]), poses=poses)

    def with_volume(self, nVoxel, dVoxel) -> Geometry:
        """The same scan with another voxel grid."""
        return replace(self, nVoxel=tuple(nVoxel), dVoxel=tuple(dVoxel))

    def rays(self) -> Rays:
        """The rays of all views in the world frame, mm."""
        if self.poses is not None:
            return self.poses
        return scanner_rays(
            self.angles, self.DSO, self.DSD, self.nDetector, self.dDetector, self.mode == 'parallel', self.offDetector
        )

    def normalised_rays(self) -> Rays:
        """The rays of all views in the normalised frame, where the volume's longest side is [-1, 1]."""
        f, centre, k = self.rays(), np.array(self.offOrigin), self.scale
        source = f.source if f.parallel else (f.source - centre) * k
        return Rays(source, (f.corner - centre) * k, f.u * k, f.v * k, f.parallel)

    @property
    def half(self) -> np.ndarray:
        """Half the volume's sides in the normalised frame, [3]; the largest is 1."""
        return np.array(self.sVoxel) * self.scale / 2


def circular(n: int, total: float = 360.0, start: float = 0.0) -> np.ndarray:
    """n angles (radians) evenly spaced over [start, start + total) degrees."""
    if n < 1:
        raise InputError(f'a scan needs at least one view, not {n}')
    return np.radians(start + total * np.arange(n) / n)


def helix(angles, pitch: float) -> np.ndarray:
    """Heights [n] in mm of a helix that climbs `pitch` mm a turn: 0 at the angle 0.

    angles   [n] radians, beyond 2 pi where it has several turns; those of two turns around z = 0 are -2 pi to 2 pi
    """
    return pitch * np.asarray(angles, float) / (2 * np.pi)


def spread(total: int, n: int) -> np.ndarray:
    """n indices evenly spaced over range(total), the first one 0: the views a sparse fit uses."""
    if not 1 <= n <= total:
        raise InputError(f'{n} views were asked for, but the scan has {total}')
    return np.arange(n) * total // n


def _circle(frames: Rays, nDetector) -> dict | None:
    """DSO, DSD, dDetector, offDetector and angles of the circle that the poses are, None where they are none."""
    out = -frames.source if frames.parallel else frames.source
    angles = np.arctan2(out[:, 1], out[:, 0])
    c, s = np.cos(angles), np.sin(angles)
    centre = frames.centre(nDetector)
    DSO = 0.0 if frames.parallel else float(np.mean(np.hypot(out[:, 0], out[:, 1])))
    circle = dict(
        DSO=DSO,
        DSD=float(DSO - np.mean(centre[:, 0] * c + centre[:, 1] * s)),
        angles=angles,
        dDetector=tuple(float(np.mean(np.linalg.norm(x, axis=1))) for x in (frames.v, frames.u)),
        offDetector=(float(np.mean(centre[:, 2])), float(np.mean(centre[:, 1] * c - centre[:, 0] * s))),
    )
    if not frames.parallel and not circle['DSD'] >= DSO > 0:
        return None
    like = scanner_rays(
        circle['angles'], DSO, circle['DSD'], nDetector, circle['dDetector'], frames.parallel, circle['offDetector']
    )
    # A beam's direction moves what it meets at a distance.
    reach = np.linalg.norm(frames.corner, axis=1).max() if frames.parallel else 1
    allowed = SAME * min(circle['dDetector'])
    near = all(
        np.abs(a - b).max() * size <= allowed
        for a, b, size in (
            (frames.source, like.source, reach),
            (frames.corner, like.corner, 1),
            (frames.u, like.u, nDetector[1]),
            (frames.v, like.v, nDetector[0]),
        )
    )
    return circle if near else None
