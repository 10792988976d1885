"""Scan geometry in TIGRE's terms: pure NumPy, no Mitsuba.

World frame, in mm: the rotation axis is z and passes through the origin, the volume's centre is `offOrigin`.
For the angle a (radians):

    source            DSO (cos a, sin a, 0)
    detector centre   (DSO - DSD) (cos a, sin a, 0) + offDetector[1] u + offDetector[0] z
    u (columns)       (-sin a, cos a, 0)
    v (rows)          (0, 0, -1)

Projections are stored [view, v, u], pixel centres at (i + 1/2) pixel steps. `offDetector` is TIGRE's (v, u): a positive
first entry lifts the panel towards +z, against the row order. Volumes are stored [x, y, z].

That is the circle, a `CircularGeometry`. Any other motion is a `PosedGeometry`, with a pose for every view. The constructors
of `Geometry` choose between the two, and whatever projects asks `rays()`.

Normalised frame: the volume's longest side is scaled to 2 and its centre moved to the origin. Lengths and line
integrals are multiplied by `Geometry.scale` = 2 / max(sVoxel); densities keep their number.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common import notebook
from lingo_mi.common.arrays import short_repr
from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.parsing import whole
from lingo_mi.geometry import astra, limits, rtk, tigre
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.circle import circle_of
from lingo_mi.geometry.drawing import drawing
from lingo_mi.geometry.limits import MOST_COUNT
from lingo_mi.geometry.rays import Index, Rays, checked_views
from lingo_mi.geometry.trajectories import Motion, helix, scanner_rays

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Placement(Motion, total=False):
    """Where scanner and volume lie, as `Geometry.cone` describes it."""

    offOrigin: ArrayLike


class ViewNumbers(Placement):
    """What every view may have of its own."""

    angles: ArrayLike


class ConeNumbers(Placement):
    """A cone beam but for its angles."""

    DSO: float
    DSD: float
    nDetector: ArrayLike
    dDetector: ArrayLike
    nVoxel: ArrayLike
    dVoxel: ArrayLike


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry(ABC):
    """A scan with a flat panel and a voxel grid: what every kind of scan has, and the constructors of both kinds.

    mode         'cone' or 'parallel'
    nDetector    pixels, (v, u): rows, columns; at least 1
    dDetector    pixel size, (v, u), mm
    nVoxel       voxels, (x, y, z); at least 1
    dVoxel       voxel size, (x, y, z), mm
    offOrigin    centre of the volume, (x, y, z), mm
    angles       [n] radians: the direction to the source, seen from above
    DSO, DSD     distances from the source to the axis and to the panel, mm

    One number may stand for all of nDetector, dDetector, nVoxel, dVoxel, offOrigin and offDetector. Wrong shapes, numbers
    that are not finite or beyond the limits of `lingo_mi.geometry.limits`, and sizes and counts that are not positive raise
    InputError.

        geometry = Geometry.cone(DSO=1000, DSD=1500, nDetector=512, dDetector=1, nVoxel=256, dVoxel=1, angles=circular(50))
        geometry.rays().source   # [50, 3], mm
    """

    mode: str
    nDetector: tuple[int, int]
    dDetector: tuple[float, float]
    nVoxel: tuple[int, int, int]
    dVoxel: tuple[float, float, float]
    angles: np.ndarray
    DSO: float
    DSD: float
    offOrigin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """For a notebook: a drawing to scale, and the numbers."""

        def sizes(counts, steps, unit):
            return f'{" x ".join(map(str, counts))} {unit} of {" x ".join(f"{step:.4g}" for step in steps)} mm'

        numbers = {'views': f'{len(self)}, a {self.mode} beam'}
        if self.mode == 'cone':
            numbers['DSO, DSD'] = f'{self.DSO:.6g}, {self.DSD:.6g} mm'
        numbers['panel (v, u)'] = sizes(self.nDetector, self.dDetector, 'pixels')
        numbers['volume (x, y, z)'] = sizes(self.nVoxel, self.dVoxel, 'voxels')
        return notebook.box(type(self).__name__, drawing(self), notebook.table(numbers))

    # ---- constructors --------------------------------------------------------------------------------------

    @classmethod
    def cone(
        cls, *, DSO: float, DSD: float, nDetector: ArrayLike, dDetector: ArrayLike, nVoxel: ArrayLike, dVoxel: ArrayLike,
        angles: ArrayLike, **placement: Unpack[Placement],
    ) -> Geometry:  # fmt: skip
        """A cone beam whose source moves on a circle about z.

        DSO, DSD    distances from the source to the axis and to the panel, mm: DSD >= DSO > 0
        angles      [n] radians, n >= 1; whole numbers over more than four turns cause a warning, as they look like degrees
        placement   offOrigin, (x, y, z) mm, the centre of the volume; offDetector, (v, u) mm, the shift of the panel, positive
                    v up; rotDetector, (roll, pitch, yaw) radians, by which it is turned; COR, mm, of an axis off centre; tilt,
                    radians, by which the source is lifted out of the plane of rotation; height, mm, once or for every view.
                    All are 0 unless given; `trajectories.Motion` defines them

        The other arguments are those of the class. Without rotDetector, COR, tilt and height it is a `CircularGeometry`.
        Raises InputError for numbers that make no scan.

            Geometry.cone(DSO=1000, DSD=1500, nDetector=(384, 512), dDetector=0.8, nVoxel=256, dVoxel=1, angles=circular(90))
        """
        scan = dict(
            DSO=DSO, DSD=DSD, nDetector=nDetector, dDetector=dDetector, nVoxel=nVoxel, dVoxel=dVoxel, angles=angles
        )
        return cls._placed('cone', scan | placement)

    @classmethod
    def parallel(
        cls, *, nDetector: ArrayLike, dDetector: ArrayLike, nVoxel: ArrayLike, dVoxel: ArrayLike, angles: ArrayLike,
        **placement: Unpack[Placement],
    ) -> Geometry:  # fmt: skip
        """A parallel beam that turns about z; the arguments are those of `cone`, without the distances.

        Its beam is not turned by rotDetector. Raises InputError for numbers that make no scan.

            Geometry.parallel(nDetector=(1, 512), dDetector=1, nVoxel=(256, 256, 1), dVoxel=1, angles=circular(90, 180))
        """
        scan = dict(nDetector=nDetector, dDetector=dDetector, nVoxel=nVoxel, dVoxel=dVoxel, angles=angles)
        return cls._placed('parallel', dict(DSO=0.0, DSD=0.0) | scan | placement)

    @classmethod
    def helix(cls, *, angles: ArrayLike, pitch: float, **scan: Unpack[ConeNumbers]) -> Geometry:
        """A cone beam whose source and panel climb `pitch` mm a turn, at z = 0 for the angle 0.

        angles   [n] radians, beyond 2 pi where there are several turns; negative ones lie below z = 0
        scan     DSO, DSD, nDetector, dDetector, nVoxel, dVoxel and the placement, as for `cone`

        Raises InputError for numbers that make no scan.

            turns = circular(180, total=1440, start=-720)   # four turns about the middle
            Geometry.helix(DSO=600, DSD=1000, nDetector=256, dDetector=1, nVoxel=128, dVoxel=1, angles=turns, pitch=32)
        """
        pitch = _numbers('pitch', pitch, float, 1)[0]
        return cls._placed('cone', dict(scan, angles=angles), pitch)

    @classmethod
    def _placed(cls, mode: str, scan: dict[str, Any], pitch: float = 0.0) -> Geometry:
        """The circle of the numbers `scan`, or what its motion makes of it where any of that is not zero."""
        motion = {name: scan.pop(name) for name in ('rotDetector', 'COR', 'height', 'tilt') if name in scan}
        circle = CircularGeometry(mode=mode, **scan)
        _warn_of_degrees(circle.angles)
        if pitch:
            climb, height = helix(circle.angles, pitch), limits.lengths('height', motion.get('height', 0.0))
            if height.shape not in ((), climb.shape):
                raise InputError(
                    f'height must be one number, or one for each of {len(climb)} views, not {shown(height)}'
                )
            motion['height'] = climb + height
        if not any(np.any(limits.numbers(name, value)) for name, value in motion.items()):
            return circle
        if 'rotDetector' in motion:
            motion['rotDetector'] = _numbers('rotDetector', motion['rotDetector'], float, 3)
        return cls.per_view(**circle.numbers(), **motion)

    @classmethod
    def per_view(
        cls, *, DSO: ArrayLike, DSD: ArrayLike, nDetector: ArrayLike, dDetector: ArrayLike, nVoxel: ArrayLike, dVoxel: ArrayLike,
        mode: str = 'cone', **views: Unpack[ViewNumbers],
    ) -> Geometry:  # fmt: skip
        """A scan whose numbers may change from view to view, in TIGRE's terms.

        DSO, DSD   mm, one number or [n]
        views      angles, [n] radians or [n, 3] Euler angles; offDetector, rotDetector, COR, height and tilt, once or for
                   every view, as `trajectories.Motion` has them; offOrigin, (x, y, z) mm, or [n, 3], TIGRE's way to move the
                   object: the grid then stays at their mean, and the scanner moves by what is left, the other way round

        Raises InputError for numbers that make no scan.

            Geometry.per_view(DSO=[900, 905], DSD=1400, nDetector=64, dDetector=2, nVoxel=64, dVoxel=1, angles=[0, 1.5])
        """
        _require_mode(mode)
        sizes: dict[str, Any] = dict(nDetector=nDetector, dDetector=dDetector, nVoxel=nVoxel, dVoxel=dVoxel)
        panel = CircularGeometry(DSO=1.0, DSD=1.0, angles=np.zeros(1), **sizes)  # one number may stand for both
        motion: dict[str, Any] = dict(views)
        DSO, DSD = limits.lengths('DSO', DSO), limits.lengths('DSD', DSD)
        origin = limits.lengths('offOrigin', motion.pop('offOrigin', 0.0))
        rays = scanner_rays(
            DSO=DSO,
            DSD=DSD,
            nDetector=panel.nDetector,
            dDetector=panel.dDetector,
            parallel=mode == 'parallel',
            **motion,
        )
        if mode == 'cone' and not (np.all(DSO > 0) and np.all(DSD >= DSO)):
            raise InputError(
                'a cone beam needs DSD >= DSO > 0 in every view (both are distances from the source, in mm)'
            )
        if origin.ndim == 2:
            if origin.shape != (len(rays), 3):
                raise InputError(
                    f'offOrigin must be 3 numbers, or that for each of {len(rays)} views, not an array of '
                    f'shape {origin.shape}'
                )
            mean = origin.mean(0)
            rays, origin = rays.moved(shift=mean - origin), mean
        return cls.from_poses(rays, panel.nDetector, nVoxel, dVoxel, origin)

    @classmethod
    def from_poses(
        cls, rays: Rays, nDetector: ArrayLike, nVoxel: ArrayLike, dVoxel: ArrayLike, offOrigin: ArrayLike = 0.0
    ) -> Geometry:
        """A scan with a given pose for every view.

        rays        in mm; the other arguments are those of the class

        Poses that are a circle's to a thousandth of a pixel (the source around z, the panel upright, rows down) give the
        `CircularGeometry`, which every file format knows, others a `PosedGeometry`. Raises InputError for poses that are
        none, see `Rays.checked`.

            Geometry.from_poses(Rays(source, corner, u, v, parallel=False), nDetector=(20, 24), nVoxel=64, dVoxel=0.5)
        """
        sizes: dict[str, Any] = dict(nDetector=nDetector, nVoxel=nVoxel, dVoxel=dVoxel, offOrigin=offOrigin)
        posed = PosedGeometry(poses=rays, **sizes)
        circle = circle_of(posed.poses, posed.nDetector)
        if circle is None:
            return posed
        return CircularGeometry(mode=posed.mode, **circle, **posed._panel_and_grid())

    @classmethod
    def from_tigre(cls, geo: Any, angles: ArrayLike) -> Geometry:
        """The scan that a geometry of TIGRE for Python describes.

        geo      `tigre.geometry`, or a dict with its names. Its own order is turned round: nVoxel, dVoxel and offOrigin are
                 (z, y, x) there, rotDetector is about (x, y, z); nDetector, dDetector and offDetector are (v, u). Lengths in
                 mm; DSO, DSD, offOrigin, offDetector, rotDetector and COR once or for every view
        angles   [n] radians or [n, 3] Euler angles, as `tigre.Ax` takes them

        TIGRE's rows run up, this package's down, and its volumes are [z, y, x]: `projections[:, ::-1]` and `volume.T` go with
        the result. Raises InputError where a number is missing or makes no scan.

            geo = tigre.geometry_default(high_resolution=False)
            scan = Scan(Geometry.from_tigre(geo, angles), tigre.Ax(image, geo, angles)[:, ::-1])
        """
        scan, moves = tigre.numbers(geo, angles)
        return cls.per_view(**scan) if moves else CircularGeometry(**scan)

    @classmethod
    def from_astra(
        cls,
        proj_geom: dict,
        vol_geom: dict | None = None,
        *,
        nVoxel: ArrayLike | None = None,
        dVoxel: ArrayLike | None = None,
    ) -> Geometry:
        """The scan that geometries of the ASTRA toolbox describe.

        proj_geom        a dict of the type 'cone', 'cone_vec', 'parallel3d' or 'parallel3d_vec'; lengths as they are
        vol_geom         a dict of `astra.create_vol_geom` in three dimensions, or instead of it
        nVoxel, dVoxel   voxels and voxel size, (x, y, z), of a grid about the origin

        ASTRA's arrays are [v, view, u] with rows that run up, and volumes [z, y, x]: `sinogram.transpose(1, 0, 2)[:, ::-1]`
        and `volume.T` go with the result. Raises InputError for other types, and where a number is missing or makes no scan.

            proj = astra.create_proj_geom('cone', 1.0, 1.0, 256, 256, np.linspace(0, 2 * np.pi, 90, False), 1000, 500)
            Geometry.from_astra(proj, astra.create_vol_geom(128, 128, 128))
        """
        if (vol_geom is None) == (nVoxel is None) or (nVoxel is None) != (dVoxel is None):
            raise InputError('an ASTRA geometry needs either vol_geom or both nVoxel and dVoxel')
        grid: dict = dict(nVoxel=nVoxel, dVoxel=dVoxel) if vol_geom is None else astra.grid(vol_geom)
        if astra.kind_of(proj_geom) in astra.CIRCLES:
            return CircularGeometry(**astra.circle(proj_geom), **grid)
        rays, nDetector = astra.views(proj_geom)
        return cls.from_poses(rays, nDetector, **grid)

    @classmethod
    def from_rtk(
        cls, source: str | PathLike | Any, *, nDetector: ArrayLike, dDetector: ArrayLike, nVoxel: ArrayLike, dVoxel: ArrayLike,
        offOrigin: ArrayLike = 0.0,
    ) -> Geometry:  # fmt: skip
        """The scan that a geometry of RTK describes.

        source   the path of its XML file, or an `itk.RTK.ThreeDCircularProjectionGeometry`

        The other arguments are those of the class: RTK says neither the panel's pixels nor the grid. Its images are taken as
        centred. RTK's axes (x, y, z) are this package's (y, z, x), and its rows run up: `stack[:, ::-1]` goes with the
        result. Raises InputError where the file is missing, damaged or another one, and for cylindrical panels.

            Geometry.from_rtk('geometry.xml', nDetector=256, dDetector=1.0, nVoxel=128, dVoxel=1.0)
        """
        nDetector, dDetector = _numbers('nDetector', nDetector, int, 2), _numbers('dDetector', dDetector, float, 2)
        rays = rtk.read(source, nDetector, dDetector)
        return cls.from_poses(rays, nDetector, nVoxel, dVoxel, offOrigin)

    # ---- what every kind has -------------------------------------------------------------------------------

    def __post_init__(self):
        for name, kind, length in (
            ('nDetector', int, 2),
            ('dDetector', float, 2),
            ('nVoxel', int, 3),
            ('dVoxel', float, 3),
            ('offOrigin', float, 3),
        ):
            value = _numbers(name, getattr(self, name), kind, length)
            if name != 'offOrigin' and min(value) <= 0:
                raise InputError(f'{name} must be positive, not {value}')
            if kind is int and max(value) > MOST_COUNT:
                raise InputError(f'{name} must be at most {MOST_COUNT} along an axis, not {shown(value)}')
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.angles)

    @abstractmethod
    def rays(self) -> Rays:
        """The rays of all views in the world frame, mm."""

    @abstractmethod
    def subset(self, index: Index) -> Geometry:
        """The same scan with the views `index` only: a slice, or integers [m]."""

    @abstractmethod
    def binned(self, factor: int) -> Geometry:
        """The same rays with `factor` x `factor` pixels taken as one; rows and columns left over are dropped.

        A side of fewer than two new pixels is not binned: see `bins`.
        """

    def joined(self, other: Geometry) -> Geometry:
        """The views of this scan, then those of another with as many pixels, on this scan's grid.

        Raises InputError where one is a cone beam and the other parallel, and where the panels differ in pixels.
        """
        if self.nDetector != other.nDetector:
            raise InputError(
                f'views of {self.nDetector} and of {other.nDetector} pixels cannot be in one scan: their panels must agree'
            )
        return PosedGeometry(poses=self.rays().joined(other.rays()), **self._panel_and_grid())

    def with_volume(self, nVoxel: ArrayLike, dVoxel: ArrayLike) -> Geometry:
        """The same scan with another voxel grid, (x, y, z), about the same centre."""
        return replace(self, nVoxel=nVoxel, dVoxel=dVoxel)

    def slab(self, begin: int, end: int) -> Geometry:
        """The same scan with the slices begin <= z < end of the voxel grid alone, where they lie.

        Raises InputError where there are no such slices.

            geometry.slab(0, 32).nVoxel   # (512, 512, 32)
        """
        (nx, ny, nz), (x, y, z) = self.nVoxel, self.offOrigin
        if not 0 <= begin < end <= nz:
            raise InputError(f'the volume has the slices 0 to {nz}, so none from {begin} to {end}')
        middle = z + ((begin + end) / 2 - nz / 2) * self.dVoxel[2]
        return replace(self, nVoxel=(nx, ny, end - begin), offOrigin=(x, y, middle))

    def slabs(self, thickness: int) -> list[tuple[int, int]]:
        """(begin, end) of slabs of so many slices along z, from the first; the last may be thinner.

        Raises InputError unless a slab has a slice.
        """
        thickness = whole('the thickness of a slab, in slices,', thickness, 1)
        return [(z, min(z + thickness, self.nVoxel[2])) for z in range(0, self.nVoxel[2], thickness)]

    @property
    def sDetector(self) -> tuple[float, float]:
        """Size of the panel, (v, u), mm."""
        (nv, nu), (dv, du) = self.nDetector, self.dDetector
        return nv * dv, nu * du

    @property
    def sVoxel(self) -> tuple[float, float, float]:
        """Size of the volume, (x, y, z), mm."""
        (nx, ny, nz), (dx, dy, dz) = self.nVoxel, self.dVoxel
        return nx * dx, ny * dy, nz * dz

    @property
    def scale(self) -> float:
        """Factor from mm to normalised lengths."""
        return 2 / max(self.sVoxel)

    @property
    def half(self) -> np.ndarray:
        """Half the volume's sides in the normalised frame, [3]; the largest is 1."""
        return np.array(self.sVoxel) * self.scale / 2

    def normalised_rays(self) -> Rays:
        """The rays of all views in the normalised frame, where the volume's longest side is [-1, 1]."""
        rays, centre, k = self.rays(), np.array(self.offOrigin), self.scale
        source = rays.source if rays.parallel else (rays.source - centre) * k
        return Rays(source, (rays.corner - centre) * k, rays.u * k, rays.v * k, rays.parallel)

    def voxel_matrices(self) -> np.ndarray:
        """Projection matrices [view, 3, 4] from voxel indices (i, j, k, 1) to (x w, y w, w), float64.

        x, y are continuous pixel positions as in `Rays`; w is the distance from the source along the panel's
        normal over its value at the axis (parallel: 1).
        """
        out = camera_matrices(self.rays())
        if self.mode == 'cone':
            out *= self.DSD / self.DSO  # w = 1 on the axis instead of the panel
        first = np.array(self.offOrigin) + (np.array(self.dVoxel) - self.sVoxel) / 2
        out[:, :, 3] += out[:, :, :3] @ first
        out[:, :, :3] *= self.dVoxel
        return out

    def bins(self, factor: int) -> tuple[int, int]:
        """How many rows and columns make one of `binned(factor)`: `factor`, or 1 along a side of fewer than two new pixels."""
        factor = whole('the binning of pixels', factor, 1)
        by_v, by_u = (factor if n >= 2 * factor else 1 for n in self.nDetector)
        return by_v, by_u

    def _require_proportions(self, nearest: float, *distances: float):
        """Raises InputError where the scan's lengths are too different. nearest: source to volume; distances: any others."""
        long = *self.sDetector, *self.sVoxel, *self.offOrigin, *distances
        short = *self.dDetector, *self.dVoxel, *([nearest] if self.mode == 'cone' else [])
        limits.require_proportions(long, short)

    def _panel_and_grid(self) -> dict:
        return {name: getattr(self, name) for name in ('nDetector', 'nVoxel', 'dVoxel', 'offOrigin')}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CircularGeometry(Geometry):
    """The source on a circle about z before an upright panel, rows down.

    offDetector   shift of the panel, (v, u), mm, positive v up

    The other numbers are those of `Geometry`. DSO and DSD of a parallel beam only place its panel. Raises InputError for
    numbers that make no scan, among them a cone beam without DSD >= DSO > 0.

        CircularGeometry(DSO=1000, DSD=1500, nDetector=512, dDetector=1, nVoxel=256, dVoxel=1, angles=[0.0, 1.5])
    """

    mode: str = 'cone'
    offDetector: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        _require_mode(self.mode)
        super().__post_init__()
        object.__setattr__(self, 'offDetector', _numbers('offDetector', self.offDetector, float, 2))
        angles = np.atleast_1d(limits.angles('angles', self.angles))
        if angles.ndim != 1 or len(angles) == 0:
            raise InputError('the scan has no views: give at least one angle')
        object.__setattr__(self, 'angles', angles)
        for name in ('DSO', 'DSD'):
            value = limits.lengths(name, getattr(self, name))
            if value.ndim:
                raise InputError(f'{name} must be one number, in mm, not {shown(getattr(self, name))}')
            object.__setattr__(self, name, float(value))
        if self.mode == 'cone' and not self.DSD >= self.DSO > 0:
            raise InputError(
                f'a cone beam needs DSD >= DSO > 0, but DSO = {self.DSO:g} and DSD = {self.DSD:g} '
                '(both are distances from the source, in mm)'
            )
        self._require_proportions(self.DSO, self.DSO, self.DSD, *self.offDetector)

    def numbers(self) -> dict:
        """All numbers by name, as the class and `Geometry.per_view` take them."""
        scanner = {name: getattr(self, name) for name in ('mode', 'DSO', 'DSD', 'dDetector', 'offDetector', 'angles')}
        return scanner | self._panel_and_grid()

    def rays(self) -> Rays:
        """The rays of all views in the world frame, mm."""
        return scanner_rays(
            self.angles,
            self.DSO,
            self.DSD,
            self.nDetector,
            self.dDetector,
            self.mode == 'parallel',
            offDetector=self.offDetector,
        )

    def subset(self, index: Index) -> CircularGeometry:
        """The same scan with the views `index` only: a slice, or integers [m]."""
        return replace(self, angles=self.angles[checked_views(index, len(self))])

    def joined(self, other: Geometry) -> Geometry:
        """The views of this scan, then those of another: see `Geometry.joined`."""
        same = 'mode', 'DSO', 'DSD', 'nDetector', 'dDetector', 'offDetector'
        if isinstance(other, CircularGeometry) and all(getattr(self, name) == getattr(other, name) for name in same):
            return replace(self, angles=np.concatenate([self.angles, other.angles]))
        return super().joined(other)

    def binned(self, factor: int) -> CircularGeometry:
        """The same rays with `factor` x `factor` pixels taken as one: see `Geometry.binned`."""
        by = self.bins(factor)
        shape = tuple(n // f for n, f in zip(self.nDetector, by))
        step = tuple(d * f for d, f in zip(self.dDetector, by))
        # Dropped pixels at the end move the panel's centre: u grows with the column, z falls with the row.
        lost = [(n - m * f) / 2 * d for n, m, f, d in zip(self.nDetector, shape, by, self.dDetector)]
        offset = (self.offDetector[0] + lost[0], self.offDetector[1] - lost[1])
        return replace(self, nDetector=shape, dDetector=step, offDetector=offset)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PosedGeometry(Geometry):
    """A scan with a pose for every view.

    poses   `Rays` of all views, mm; the other arguments are nDetector, nVoxel, dVoxel and offOrigin

    What the poses imply is for labels: DSO is the mean distance from the source to the volume's centre, DSD that to the
    panel's plane, dDetector the mean length of the steps, `angles` the directions to the source as seen from above. Raises
    InputError for poses that are none, see `Rays.checked`. `Geometry.from_poses` gives a `CircularGeometry` where it can.

        PosedGeometry(poses=Rays(source, corner, u, v, parallel=False), nDetector=(20, 24), nVoxel=64, dVoxel=0.5)
    """

    poses: Rays = field(repr=False)
    mode: str = field(init=False)
    dDetector: tuple[float, float] = field(init=False)
    angles: np.ndarray = field(init=False)
    DSO: float = field(init=False)
    DSD: float = field(init=False)

    def __post_init__(self):
        rays = self.poses.checked()
        step_v, step_u = (float(np.mean(np.linalg.norm(x, axis=1))) for x in (rays.v, rays.u))
        object.__setattr__(self, 'poses', rays)
        object.__setattr__(self, 'mode', 'parallel' if rays.parallel else 'cone')
        object.__setattr__(self, 'dDetector', (step_v, step_u))
        super().__post_init__()
        toward = -rays.source if rays.parallel else rays.source - np.asarray(self.offOrigin)
        object.__setattr__(self, 'angles', np.arctan2(toward[:, 1], toward[:, 0]))
        normal = np.cross(rays.u, rays.v)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        to_panel = rays.corner if rays.parallel else rays.corner - rays.source
        object.__setattr__(self, 'DSO', 0.0 if rays.parallel else float(np.mean(np.linalg.norm(toward, axis=1))))
        object.__setattr__(self, 'DSD', float(np.mean(np.abs(np.sum(to_panel * normal, 1)))))
        nearest = float(np.linalg.norm(toward, axis=1).min())
        self._require_proportions(nearest, self.DSO, self.DSD, np.abs(rays.corner).max())

    def rays(self) -> Rays:
        """The rays of all views in the world frame, mm."""
        return self.poses

    def subset(self, index: Index) -> PosedGeometry:
        """The same scan with the views `index` only: a slice, or integers [m]."""
        return replace(self, poses=self.poses[checked_views(index, len(self))])

    def binned(self, factor: int) -> PosedGeometry:
        """The same rays with `factor` x `factor` pixels taken as one: see `Geometry.binned`."""
        by_v, by_u = self.bins(factor)
        nv, nu = self.nDetector
        poses = replace(self.poses, u=self.poses.u * by_u, v=self.poses.v * by_v)
        return replace(self, nDetector=(nv // by_v, nu // by_u), poses=poses)


def _require_mode(mode: Any):
    if not (isinstance(mode, str) and mode in ('cone', 'parallel')):
        raise InputError(f"mode must be 'cone' or 'parallel', not {shown(mode)}")


def _numbers(name: str, value: ArrayLike, kind: type, length: int) -> tuple:
    """`length` finite numbers of a kind, no larger than lengths may be; one may stand for all."""
    array = np.atleast_1d(limits.numbers(name, value)).ravel()
    if len(array) == 1:
        array = np.repeat(array, length)
    if len(array) != length or not np.all(np.isfinite(array)):
        raise InputError(
            f'{name} must be {"one finite number" if length == 1 else f"{length} finite numbers"}, not {shown(value)}'
        )
    if kind is int and np.any(array % 1):
        raise InputError(f'{name} must be whole numbers, not {shown(value)}')
    limits.lengths(name, array)
    return tuple(kind(x) for x in array)


def _warn_of_degrees(angles: np.ndarray) -> None:
    """Warn, in the name of the caller's caller's caller, if angles in radians look like degrees."""
    if np.ptp(angles) > 8 * np.pi and not np.any(angles % 1):
        warnings.warn(
            f'angles are radians, but these are whole numbers from {angles.min():g} to {angles.max():g}: '
            'if they are degrees, give numpy.radians(angles)',
            stacklevel=4,
        )
