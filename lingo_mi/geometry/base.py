"""A scanner in TIGRE's terms: what every kind has, and the constructors of all kinds. Pure NumPy, no Mitsuba.

World frame, in mm: the rotation axis is z and passes through the origin, the volume's centre is `grid.centre`.
For the angle a (radians):

    source            DSO (cos a, sin a, 0)
    detector centre   (DSO - DSD) (cos a, sin a, 0) + offDetector[1] u + offDetector[0] z
    u (columns)       (-sin a, cos a, 0)
    v (rows)          (0, 0, -1)

Projections are stored [view, v, u], pixel centres at (i + 1/2) pixel steps. `offDetector` is TIGRE's (v, u): a positive
first entry lifts the panel towards +z, against the row order. Volumes are stored [x, y, z].

That is the circle, a `CircularGeometry`. Any other motion is a `PosedGeometry`, with a pose for every view. The constructors
of `Geometry` choose between the two, and whatever projects asks `rays()`. `Geometry.curved` bends the panel of either.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common import notebook
from lingo_mi.common.arrays import short_repr
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole_number
from lingo_mi.geometry import limits
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.drawing import drawing
from lingo_mi.geometry.grid import Grid, Voxels, grid_of
from lingo_mi.geometry.rays import Index, Rays, checked_views
from lingo_mi.geometry.trajectories import Motion

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from typing_extensions import Self, Unpack

    from lingo_mi.geometry.curved import CurvedGeometry


class Placement(Motion, Voxels, total=False):
    """Place of scanner and volume, as `Geometry.cone` describes it."""


class ViewNumbers(Placement):
    """Numbers that may differ from view to view."""

    angles: ArrayLike


class ConeNumbers(Placement):
    """The numbers of a cone beam, without its angles."""

    DSO: float
    DSD: float
    nDetector: ArrayLike
    dDetector: ArrayLike


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry(ABC):
    """The geometry of a scan, and the voxels to reconstruct. Make one with `cone`, `parallel` or a `from_...` method.

    Parameters
    ----------
    mode : str
        'cone' or 'parallel'.
    nDetector : [2]
        Pixels (v, u), rows and columns, at least 1. One number, here or in dDetector and offDetector, holds for both axes.
    dDetector : [2]
        Pixel size, (v, u), mm.
    grid : Grid
        The voxels.
    angles : [n]
        Direction to the source, counter-clockwise seen from above, radians.
    DSO, DSD : float
        Distances from the source to the axis and to the panel, mm.

    Raises
    ------
    InputError
        For wrong shapes, numbers that are not finite or beyond the limits of `lingo_mi.geometry.limits`, and sizes and counts
        that are not positive.

    Examples
    --------
    >>> from lingo_mi.geometry import circular
    >>> geometry = Geometry.cone(
    ...     DSO=1000, DSD=1500, nDetector=512, dDetector=1, grid=Grid(256, 1.0), angles=circular(50)
    ... )
    >>> geometry.rays().source.shape
    (50, 3)
    """

    mode: str
    nDetector: tuple[int, int]
    dDetector: tuple[float, float]
    grid: Grid
    angles: np.ndarray
    DSO: float
    DSD: float

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """For a notebook: a drawing to scale, and the numbers."""

        def sizes(counts, steps, unit):
            return f'{" x ".join(map(str, counts))} {unit} of {" x ".join(f"{step:.4g}" for step in steps)} mm'

        numbers = {'views': f'{len(self)}, a {self.mode} beam'}
        if self.mode == 'cone':
            numbers['DSO, DSD'] = f'{self.DSO:.6g}, {self.DSD:.6g} mm'
        numbers['panel (v, u)'] = sizes(self.nDetector, self.dDetector, 'pixels')
        numbers['volume (x, y, z)'] = sizes(self.grid.shape, self.grid.spacing, 'voxels')
        picture = drawing(self.rays(curved=True), self.nDetector, self.grid)
        return notebook.box(type(self).__name__, picture, notebook.table(numbers))

    # ---- constructors: the kinds that they make build on this class, so that it imports them late ---------------

    @classmethod
    def cone(
        cls, *, DSO: float, DSD: float, nDetector: ArrayLike, dDetector: ArrayLike, angles: ArrayLike,
        **placement: Unpack[Placement],
    ) -> Geometry:  # fmt: skip
        """A cone beam whose source moves on a circle about z.

        Parameters
        ----------
        DSO, DSD : float
            Distances from the source to the axis and to the panel, mm: DSD >= DSO > 0.
        nDetector, dDetector
            Pixels and pixel size in mm, (v, u).
        angles : [n]
            Radians, n >= 1. Whole numbers that span more than four turns cause a warning, because they look like degrees.
        **placement
            The voxels: either `grid`, or TIGRE's numbers (x, y, z): nVoxel, dVoxel in mm, and offOrigin, the centre, in mm. The
            other numbers are 0 by default, and `trajectories.Motion` defines them: offDetector, (v, u) mm, shifts the panel, a
            positive v towards +z; rotDetector, (roll, pitch, yaw) radians, turns it; COR, mm, is for an axis off centre; tilt,
            radians, lifts the source out of the plane of rotation; height, mm, once or for every view, lifts source and panel.

        Returns
        -------
        Geometry
            A `CircularGeometry` if rotDetector, COR, tilt and height are 0, otherwise a scan with poses.

        Raises
        ------
        InputError
            For numbers that make no scan, and unless exactly one of `grid` and TIGRE's numbers describes the voxels.

        Examples
        --------
        >>> half_turn = np.linspace(0, np.pi, 90, endpoint=False)
        >>> one = Geometry.cone(DSO=1000, DSD=1500, nDetector=512, dDetector=0.8, grid=Grid(256, 1.0), angles=half_turn)
        >>> same = Geometry.cone(DSO=1000, DSD=1500, nDetector=512, dDetector=0.8, nVoxel=256, dVoxel=1, angles=half_turn)
        >>> one.grid == same.grid
        True
        """
        from lingo_mi.geometry.constructors import circle_or_poses

        scan = dict(DSO=DSO, DSD=DSD, nDetector=nDetector, dDetector=dDetector, angles=angles)
        return circle_or_poses('cone', scan | placement)

    @classmethod
    def parallel(
        cls, *, nDetector: ArrayLike, dDetector: ArrayLike, angles: ArrayLike, **placement: Unpack[Placement]
    ) -> Geometry:
        """A parallel beam that turns about z.

        Parameters
        ----------
        nDetector, dDetector
            Pixels and pixel size in mm, (v, u).
        angles : [n]
            Radians, n >= 1.
        **placement
            The voxels and the motions, as in `cone`. rotDetector does not turn the beam.

        Returns
        -------
        Geometry
            A `CircularGeometry` if rotDetector, COR, tilt and height are 0, otherwise a scan with poses.

        Raises
        ------
        InputError
            For numbers that make no scan.

        Examples
        --------
        >>> flat = Grid((256, 256, 1), 1.0)
        >>> len(Geometry.parallel(nDetector=(1, 512), dDetector=1, grid=flat, angles=[0.0, 0.7]))
        2
        """
        from lingo_mi.geometry.constructors import circle_or_poses

        scan = dict(DSO=0.0, DSD=0.0, nDetector=nDetector, dDetector=dDetector, angles=angles)
        return circle_or_poses('parallel', scan | placement)

    @classmethod
    def helix(cls, *, angles: ArrayLike, pitch: float, **scan: Unpack[ConeNumbers]) -> Geometry:
        """A cone beam whose source and panel climb along z, and are at z = 0 for the angle 0.

        Parameters
        ----------
        angles : [n]
            Radians, beyond 2 pi if there are several turns. Negative angles lie below z = 0.
        pitch : float
            Climb of a turn, mm. A negative pitch descends.
        **scan
            The other parameters of `cone`.

        Returns
        -------
        Geometry
            A scan with a pose for every view.

        Raises
        ------
        InputError
            For numbers that make no scan.

        Examples
        --------
        >>> from lingo_mi.geometry import circular
        >>> turns = circular(180, total=1440, start=-720)  # four turns about the middle
        >>> g = Geometry.helix(DSO=600, DSD=1000, nDetector=256, dDetector=1, grid=Grid(128, 1.0), angles=turns, pitch=32)
        >>> float(g.rays().source[0, 2])
        -64.0
        """
        from lingo_mi.geometry.constructors import circle_or_poses

        return circle_or_poses('cone', dict(scan, angles=angles), limits.vector('pitch', pitch, 1)[0])

    @classmethod
    def per_view(
        cls, *, DSO: ArrayLike, DSD: ArrayLike, nDetector: ArrayLike, dDetector: ArrayLike, mode: str = 'cone',
        **views: Unpack[ViewNumbers],
    ) -> Geometry:  # fmt: skip
        """A scan whose numbers may change from view to view, in TIGRE's terms.

        Parameters
        ----------
        DSO, DSD : float or [n]
            Distances from the source to the axis and to the panel, mm.
        nDetector, dDetector
            Pixels and pixel size in mm, (v, u), the same in all views.
        mode : {'cone', 'parallel'}
            Kind of beam.
        **views
            angles, [n] radians or [n, 3] Euler angles; offDetector, rotDetector, COR, height and tilt, once or for every view;
            the voxels as in `cone`. offOrigin may be [n, 3], which is TIGRE's way to move the object. The grid then stays at the
            mean, and the scanner moves by the differences from it, in the opposite direction.

        Returns
        -------
        Geometry
            A `CircularGeometry` if the views lie on a circle, else a scan with a pose for every view.

        Raises
        ------
        InputError
            For numbers that make no scan.

        Examples
        --------
        >>> panel = dict(nDetector=64, dDetector=2)
        >>> Geometry.per_view(DSO=[900, 905], DSD=1400, grid=Grid(64, 1.0), angles=[0, 1.5], **panel).DSO
        902.5
        """
        from lingo_mi.geometry.constructors import per_view

        return per_view(mode, DSO, DSD, nDetector, dDetector, dict(views))

    @classmethod
    def from_poses(cls, rays: Rays, nDetector: ArrayLike, **voxels: Unpack[Voxels]) -> Geometry:
        """A scan with a pose for every view.

        Parameters
        ----------
        rays : Rays
            Poses of all views, mm.
        nDetector
            Pixels, (v, u).
        **voxels
            Either grid, or nVoxel, dVoxel and offOrigin, as in `cone`.

        Returns
        -------
        Geometry
            A `CircularGeometry`, which every file format knows, if the poses are on a circle to a thousandth of a pixel (the
            source around z, the panel upright, rows down). A `CurvedGeometry` if the rays have a curve. Otherwise a
            `PosedGeometry`.

        Raises
        ------
        InputError
            For rays that make no view, see `Rays.checked`.

        Examples
        --------
        >>> from lingo_mi.geometry import scanner_rays
        >>> rays = scanner_rays([0.0, 1.5], 900, 1400, (20, 24), (1.0, 1.0), tilt=0.1)
        >>> Geometry.from_poses(rays, (20, 24), grid=Grid(64, 0.5)).nDetector
        (20, 24)
        """
        from lingo_mi.geometry.constructors import from_poses

        return from_poses(rays, nDetector, grid_of(voxels))

    @classmethod
    def from_tigre(cls, geo: Any, angles: ArrayLike) -> Geometry:
        """The scan that a geometry of TIGRE for Python describes.

        Parameters
        ----------
        geo : tigre.utilities.geometry.Geometry or dict
            TIGRE's geometry, mm; see `lingo_mi.geometry.tigre.scan`.
        angles : [n] or [n, 3]
            TIGRE's angles, radians.

        Returns
        -------
        Geometry
            The same rays and voxels.

        Raises
        ------
        InputError
            If a number is missing, or for numbers that make no scan.

        Examples
        --------
        `geometry = lm.Geometry.from_tigre(geo, np.linspace(0, 2 * np.pi, 50, endpoint=False))`
        """
        from lingo_mi.geometry import tigre

        return tigre.scan(geo, angles)

    @classmethod
    def from_astra(cls, proj_geom: dict, vol_geom: dict | None = None, **voxels: Unpack[Voxels]) -> Geometry:
        """The scan that geometries of the ASTRA toolbox describe.

        Parameters
        ----------
        proj_geom : dict
            Projection geometry, by `astra.create_proj_geom`; see `lingo_mi.geometry.astra.scan`.
        vol_geom : dict, optional
            Volume geometry, by `astra.create_vol_geom`.
        **voxels
            In place of vol_geom: grid, or nVoxel, dVoxel and offOrigin, as in `cone`.

        Returns
        -------
        Geometry
            The same rays and voxels.

        Raises
        ------
        InputError
            If a number is missing, or for numbers that make no scan.

        Examples
        --------
        `geometry = lm.Geometry.from_astra(proj_geom, vol_geom)`
        """
        from lingo_mi.geometry import astra

        return astra.scan(proj_geom, vol_geom, **voxels)

    @classmethod
    def from_rtk(
        cls, source: str | PathLike | Any, *, nDetector: ArrayLike, dDetector: ArrayLike, **voxels: Unpack[Voxels]
    ) -> Geometry:
        """The scan that a geometry of RTK describes.

        Parameters
        ----------
        source : path-like or object
            A file of RTK's, or an `itk.RTK.ThreeDCircularProjectionGeometry`; see `lingo_mi.geometry.rtk.scan`.
        nDetector, dDetector
            Pixels and pixel size in mm, (v, u), which RTK keeps with the projections.
        **voxels
            Either grid, or nVoxel, dVoxel and offOrigin, as in `cone`.

        Returns
        -------
        Geometry
            The same rays.

        Raises
        ------
        InputError
            If the file is missing or damaged, or for numbers that make no scan.

        Examples
        --------
        `geometry = lm.Geometry.from_rtk('geometry.xml', nDetector=512, dDetector=0.8, nVoxel=256, dVoxel=1)`
        """
        from lingo_mi.geometry import rtk

        return rtk.scan(source, nDetector=nDetector, dDetector=dDetector, **voxels)

    # ---- what every kind has -------------------------------------------------------------------------------

    def __post_init__(self):
        object.__setattr__(self, 'nDetector', limits.counts('nDetector', self.nDetector, 2))
        object.__setattr__(self, 'dDetector', limits.sizes('dDetector', self.dDetector, 2))
        require_type('grid', self.grid, Grid, 'give Grid(shape, spacing)')

    def __len__(self) -> int:
        return len(self.angles)

    @abstractmethod
    def rays(self, curved: bool = False) -> Rays:
        """The rays of all views in the world frame, mm.

        Parameters
        ----------
        curved : bool
            Whether the caller supports curved panels, whose rays have a `Rays.curve`. If not, curved panels are refused.

        Returns
        -------
        Rays
            Sources, corners and steps of the panels, [view, 3] each.

        Raises
        ------
        InputError
            For a curved panel, unless `curved`.
        """

    @abstractmethod
    def subset(self, index: Index) -> Geometry:
        """The same scan with some of its views.

        Parameters
        ----------
        index : slice or [m]
            The views: a slice, or integers.

        Returns
        -------
        Geometry
            A geometry of the same kind.
        """

    @abstractmethod
    def binned(self, factor: int) -> Geometry:
        """The same scan with `factor` x `factor` pixels joined into one. Remaining rows and columns are dropped.

        Parameters
        ----------
        factor : int
            Pixels a side, at least 1. A side of fewer than two new pixels is not binned: see `bins`.

        Returns
        -------
        Geometry
            A geometry of the same kind.
        """

    def joined(self, other: Geometry) -> Geometry:
        """The views of this scan, then the views of another, on this scan's grid.

        Parameters
        ----------
        other : Geometry
            A scan with the same beam and as many pixels.

        Returns
        -------
        Geometry
            All views.

        Raises
        ------
        InputError
            If one is a cone beam and the other parallel, and if the panels differ in pixels.
        """
        from lingo_mi.geometry.posed import PosedGeometry

        if self.nDetector != other.nDetector:
            raise InputError(
                f'views of {self.nDetector} and of {other.nDetector} pixels cannot be in one scan: their panels must agree'
            )
        return PosedGeometry(poses=self.rays().joined(other.rays()), nDetector=self.nDetector, grid=self.grid)

    def on(self, grid: Grid) -> Self:
        """The same scan with other voxels.

        Parameters
        ----------
        grid : Grid
            The new voxels, mm.

        Returns
        -------
        Geometry
            A geometry of the same kind.

        Examples
        --------
        >>> scan = Geometry.parallel(nDetector=8, dDetector=1, grid=Grid(8, 1.0), angles=[0.0])
        >>> scan.on(scan.grid.slab(0, 2)).grid.shape
        (8, 8, 2)
        """
        return replace(self, grid=grid)

    @property
    def sDetector(self) -> tuple[float, float]:
        """Size of the panel, (v, u), mm."""
        (nv, nu), (dv, du) = self.nDetector, self.dDetector
        return nv * dv, nu * du

    def normalised_rays(self, curved: bool = False) -> Rays:
        """The rays of all views in the normalised frame of the grid, whose longest side is 2.

        Parameters
        ----------
        curved : bool
            As for `rays`.

        Returns
        -------
        Rays
            Sources, corners and steps of the panels, [view, 3] each.
        """
        rays, centre, k = self.rays(curved), np.array(self.grid.centre), self.grid.scale
        source = rays.source if rays.parallel else (rays.source - centre) * k
        return replace(rays, source=source, corner=(rays.corner - centre) * k, u=rays.u * k, v=rays.v * k)

    def curved(self, radius: float | None = None) -> CurvedGeometry:
        """The same scan with its panel bent towards the source on a cylinder, whose axis runs along the panel's columns.

        Columns are then dDetector[1] apart along the arc. The curved panel touches the flat one at the foot of the perpendicular
        from the source, and offDetector[1] moves the panel along its arc.

        Parameters
        ----------
        radius : float, optional
            Radius of the cylinder, mm (default: DSD). With DSD the cylinder's axis passes through the focal spot, as in clinical
            scanners, and the angle between neighbouring columns is dDetector[1] / DSD.

        Returns
        -------
        CurvedGeometry
            The curved scan.

        Raises
        ------
        InputError
            For a parallel beam, a radius that is not positive, an arc of 180 degrees or more, rows and columns that are not at
            right angles, and a source that does not see the whole panel from within.

        Examples
        --------
        A clinical scanner, its panel a quarter of a pixel off:

        >>> panel = dict(nDetector=(32, 736), dDetector=(1.0947, 1.2858), offDetector=(0, 1.2858 / 4))
        >>> flat = Geometry.cone(DSO=595, DSD=1085.6, **panel, nVoxel=(256, 256, 16), dVoxel=1.6, angles=[0, 1])
        >>> flat.curved().radius
        1085.6
        """
        from lingo_mi.geometry.curved import curved

        return curved(self, radius)

    def source_shifted(self, shift: ArrayLike) -> Geometry:
        """The same panels with shifted sources: a flying focal spot.

        Parameters
        ----------
        shift : [3] or [view, 3]
            Shift of the source, mm: along the rows (u), against the columns (up, for an upright panel), and away from the panel.

        Returns
        -------
        Geometry
            The scan with the shifted sources.

        Raises
        ------
        InputError
            For another shape, and for a parallel beam.

        Examples
        --------
        Two places along the rows in turn:

        >>> scan = Geometry.cone(DSO=595, DSD=1085.6, nDetector=8, dDetector=1, nVoxel=8, dVoxel=1, angles=[0.0, 0.1])
        >>> moved = scan.source_shifted([[-0.6, 0, 0], [0.6, 0, 0]])
        """
        from lingo_mi.geometry.constructors import source_shifted

        return source_shifted(self, shift)

    def show(self, views: Index | None = None) -> Figure:
        """Draw the scanner to scale: rays, panel and volume, from above and from the side of the first view.

        Parameters
        ----------
        views : slice or sequence of int, optional
            Views to draw with their panel and outermost rays, the first one strongest (default: three, evenly spaced). Dots are
            the sources of all views.

        Returns
        -------
        matplotlib.figure.Figure
            It shows itself in a notebook; `savefig` writes it to a file.

        Raises
        ------
        InputError
            For views that the scan does not have, and for none.

        Examples
        --------
        ::

            geometry.show(views=[0, 10]).savefig('scanner.png')
        """
        from lingo_mi.geometry.figure import DRAWN, figure

        count = len(self)
        spaced = np.unique(np.arange(DRAWN) * count // DRAWN)
        chosen = spaced if views is None else np.arange(count)[checked_views(views, count)]
        if len(chosen) == 0:
            raise InputError('no views are chosen: choose at least one to draw')
        return figure(self, chosen)

    def voxel_matrices(self) -> np.ndarray:
        """Projection matrices from voxel indices to pixel positions.

        They take (i, j, k, 1) to (x w, y w, w). x, y are continuous pixel positions as in `Rays`, on the flat panel that a
        curved one touches. w is the distance from the source along the panel's normal over its value at the axis (parallel: 1).

        Returns
        -------
        ndarray
            Float64 [view, 3, 4].
        """
        out, grid = camera_matrices(self.rays(curved=True)), self.grid
        if self.mode == 'cone':
            out *= self.DSD / self.DSO  # w = 1 on the axis instead of the panel
        first = np.array(grid.centre) + (np.array(grid.spacing) - grid.size) / 2
        out[:, :, 3] += out[:, :, :3] @ first
        out[:, :, :3] *= grid.spacing
        return out

    def bins(self, factor: int) -> tuple[int, int]:
        """Return the numbers of rows and of columns that `binned` joins.

        Parameters
        ----------
        factor : int
            The factor of `binned`, at least 1.

        Returns
        -------
        tuple[int, int]
            (v, u): `factor`, or 1 along a side of fewer than two new pixels.

        Raises
        ------
        InputError
            For a factor below 1.
        """
        factor = whole_number('the binning of pixels', factor, 1)
        by_v, by_u = (factor if n >= 2 * factor else 1 for n in self.nDetector)
        return by_v, by_u

    def _require_proportions(self, nearest: float, *distances: float):
        """Raises InputError if the scan's lengths are too different. nearest: source to volume; distances: any others."""
        long = *self.sDetector, *self.grid.size, *self.grid.centre, *distances
        short = *self.dDetector, *self.grid.spacing, *([nearest] if self.mode == 'cone' else [])
        limits.require_proportions(long, short)
