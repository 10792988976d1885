"""A scan whose panel is bent on a cylinder, as in clinical scanners."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import limits
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.constructors import from_poses
from lingo_mi.geometry.curve import Curve
from lingo_mi.geometry.grid import Grid
from lingo_mi.geometry.rays import Index, Rays

RIGHT_ANGLE = 1e-6  # the largest cosine between rows and columns
SLACK = 1e-6  # columns and rows that rounding may take
SAME = 1e-9  # columns by which a panel may be off the foot of its source and still be in its place


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CurvedGeometry(Geometry):
    """A cone beam before a panel that is bent on a cylinder: rows run along the arc, columns along the cylinder's axis.

    `Geometry.curved` makes one in a clinical scanner's terms. Here the panel touches a flat one along its middle, on the side of
    the source. Its columns are as far apart along the arc as the flat one's along u, as in ASTRA's `cyl_cone_vec`.

    Voxels and Gaussians are projected along the exact rays. Functions that need a flat panel raise InputError, and `Scan.to_flat`
    resamples the scan for them.

    Parameters
    ----------
    flat : Geometry
        The cone beam with the flat panel. It defines DSO, DSD, dDetector and angles.
    radius : float
        Radius of the cylinder, mm.

    Raises
    ------
    InputError
        For a parallel beam, a radius that is not positive, an arc of half a turn or more, rows and columns that are not at right
        angles, and a source that does not see the whole panel from within.

    References
    ----------
    Buzug, "Computed Tomography", Springer 2008, section 3.6: curved panels of the third generation.

    Examples
    --------
    >>> from lingo_mi.geometry import Grid, circular
    >>> panel = dict(nDetector=(32, 736), dDetector=1.2858)
    >>> flat = Geometry.cone(DSO=595, DSD=1085.6, **panel, grid=Grid((256, 256, 16), 1.6), angles=circular(36))
    >>> CurvedGeometry(flat=flat, radius=1085.6).radius
    1085.6
    """

    flat: Geometry
    radius: float
    mode: str = field(init=False)
    nDetector: tuple[int, int] = field(init=False)
    dDetector: tuple[float, float] = field(init=False)
    grid: Grid = field(init=False)
    angles: np.ndarray = field(init=False)
    DSO: float = field(init=False)
    DSD: float = field(init=False)
    _curve: Curve = field(init=False)

    def __post_init__(self):
        for name in ('mode', 'nDetector', 'dDetector', 'grid', 'angles', 'DSO', 'DSD'):
            object.__setattr__(self, name, getattr(self.flat, name))
        object.__setattr__(self, 'radius', limits.sizes('radius', self.radius, 1)[0])
        limits.require_proportions((self.radius,), self.dDetector)
        object.__setattr__(self, '_curve', bent(self.flat.rays(), self.nDetector, self.radius).curve)

    def rays(self, curved: bool = False) -> Rays:
        """The rays of all views in the world frame, mm.

        Raises
        ------
        InputError
            Unless `curved` says that the caller knows curved panels.
        """
        if not curved:
            raise InputError(
                'this needs a flat panel, and the panel of this scan is curved: resample the scan with scan.to_flat()'
            )
        return replace(self.flat.rays(), curve=self._curve)

    def curved(self, radius: float | None = None) -> CurvedGeometry:
        """Raises InputError: the panel is curved already."""
        raise InputError('the panel of this scan is curved already')

    def subset(self, index: Index) -> CurvedGeometry:
        """The same scan with the views `index` only: a slice, or integers [m]."""
        return replace(self, flat=self.flat.subset(index))

    def on(self, grid: Grid) -> CurvedGeometry:
        """The same scan with other voxels."""
        return replace(self, flat=self.flat.on(grid))

    def joined(self, other: Geometry) -> CurvedGeometry:
        """The views of this scan, then the views of another whose panel has the same pixels and radius.

        Raises
        ------
        InputError
            If the panels differ.
        """
        if not isinstance(other, CurvedGeometry) or abs(other.radius / self.radius - 1) > 1e-9:
            raise InputError('views of panels of different radius cannot be in one scan')
        return replace(self, flat=self.flat.joined(other.flat))

    def binned(self, factor: int) -> CurvedGeometry:
        """The same arc with `factor` x `factor` pixels taken as one: see `Geometry.binned`."""
        flat, (_, by) = self.flat.binned(factor), self.bins(factor)
        lost = (self.nDetector[1] - flat.nDetector[1] * by) / 2 * np.linalg.norm(self.flat.rays().u, axis=1)
        if lost.any():  # columns at the end: the middle of the others lies further back on the arc
            level = flat.rays()
            level = replace(level, corner=level.corner + (lost / np.linalg.norm(level.u, axis=1))[:, None] * level.u)
            flat = from_poses(slid(level, flat.nDetector, self.radius, -lost), flat.nDetector, self.grid)
        return replace(self, flat=flat)

    def source_shifted(self, shift: ArrayLike) -> CurvedGeometry:
        """The same panels, seen from elsewhere: see `Geometry.source_shifted`."""
        return replace(self, flat=self.flat.source_shifted(shift))

    def to_flat(self) -> Geometry:
        """The scan with a flat panel, `flat` cut or extended to `flat_pixels`.

        Raises
        ------
        InputError
            As `flat_pixels`.
        """
        top, bottom, left, right = self.flat_pixels()
        return from_poses(self.flat.rays().cropped(left, top), (bottom - top, right - left), self.grid)

    def flat_pixels(self) -> tuple[int, int, int, int]:
        """The rows [top, bottom) and columns [left, right) on the plane of `flat` that this panel sees in all views.

        They are as fine as this panel's pixels in its middle. Rows that only the sides of the panel see are left out.

        Raises
        ------
        InputError
            For a panel that sees no row from side to side, and for more columns than a panel may have.
        """
        curve, (rows, columns) = self._curve, self.nDetector
        x = np.linspace(0, columns, 2 * columns + 1)
        edges, share, foot = curve.columns(x[[0, -1]]), curve.share(x), curve.foot_v[:, None]
        edges = np.clip(edges, -limits.MOST_COUNT, limits.MOST_COUNT)
        left, right = int(np.ceil(edges[:, 0].max() - SLACK)), int(np.floor(edges[:, 1].min() + SLACK))
        top = int(np.ceil((foot - foot / share).max() - SLACK))
        bottom = int(np.floor((foot + (rows - foot) / share).min() + SLACK))
        if top >= bottom or left >= right:
            raise InputError('no row of the curved panel is whole on a flat one, and it cannot be resampled')
        limits.counts('the columns of the flat panel', right - left, 1)
        return top, bottom, left, right


def curved(geometry: Geometry, radius: float | None) -> CurvedGeometry:
    """The scan of `Geometry.curved`."""
    rays = geometry.rays()
    require_bendable(rays)
    radius = float(limits.sizes('radius', geometry.DSD if radius is None else radius, 1)[0])
    # The source's foot along u from the panel's middle. The arc touches the flat panel there; the rest goes along the arc.
    step = np.linalg.norm(rays.u, axis=1)
    off = np.sum((rays.source - rays.centre(geometry.nDetector)) * rays.u, 1) / step
    if np.abs(off / step).max() > SAME:
        touching = replace(rays, corner=rays.corner + (off / step)[:, None] * rays.u)
        curve_of(rays, geometry.nDetector, radius)  # refuses an arc that cannot be followed
        geometry = from_poses(slid(touching, geometry.nDetector, radius, -off), geometry.nDetector, geometry.grid)
    return CurvedGeometry(flat=geometry, radius=radius)


def require_bendable(rays: Rays) -> None:
    """Raises InputError for panels that cannot be bent: of a parallel beam, or whose rows and columns are not at right angles."""
    if rays.parallel:
        raise InputError('a parallel beam has no curved panel: leave out radius, or give a cone beam')
    cosine = np.sum(rays.u * rays.v, 1) / np.linalg.norm(rays.u, axis=1) / np.linalg.norm(rays.v, axis=1)
    if np.abs(cosine).max() > RIGHT_ANGLE:
        raise InputError('a curved panel needs rows and columns at right angles')


def bent(rays: Rays, nDetector: tuple[int, int], radius: float) -> Rays:
    """The rays of curved panels that touch the flat ones of `rays` along their middle.

    Raises
    ------
    InputError
        As `CurvedGeometry`.
    """
    require_bendable(rays)
    return replace(rays, curve=curve_of(rays, nDetector, limits.sizes('radius', radius, 1)[0]))


def slid(rays: Rays, nDetector: tuple[int, int], radius: float, by: np.ndarray) -> Rays:
    """The flat panels that curved ones touch after a slide along their arcs by `by`, mm [n], towards growing columns."""
    turn, step = (by / radius)[:, None], np.linalg.norm(rays.u, axis=1, keepdims=True)
    along, up = rays.u / step, towards_source(rays)
    middle = rays.centre(nDetector) + radius * (np.sin(turn) * along + (1 - np.cos(turn)) * up)
    u = step * (np.cos(turn) * along + np.sin(turn) * up)
    return replace(rays, u=u, corner=middle - nDetector[1] / 2 * u - nDetector[0] / 2 * rays.v)


def curve_of(rays: Rays, nDetector: tuple[int, int], radius: float) -> Curve:
    """Return the bend of panels that touch the flat panels of `rays` along their middle, mm.

    Raises
    ------
    InputError
        For an arc of half a turn or more, and for a source that does not see the whole panel from within.
    """
    step, to_source = np.linalg.norm(rays.u, axis=1), rays.source - rays.corner
    arc = np.degrees(nDetector[1] * step.max() / radius)
    if not arc < 180:
        raise InputError(
            f'the panel is an arc of {arc:.4g} degrees, and must be one of less than 180: check radius, nDetector and dDetector'
        )
    curve = Curve(
        nDetector[1] / 2,
        radius / step,
        np.sum(to_source * rays.u, 1) / step**2,
        np.sum(to_source * rays.v, 1) / np.sum(rays.v**2, 1),
        np.abs(np.sum(to_source * towards_source(rays), 1)) / step,
    )
    # A ray leaves the cylinder at the panel if it runs away from the axis there.
    angle = np.array([[-0.5], [0.5]]) * nDetector[1] / curve.radius
    ahead = curve.distance - curve.radius * (1 - np.cos(angle))
    aside = curve.middle + curve.radius * np.sin(angle) - curve.foot_u
    if not ((ahead > 0) & (np.sin(angle) * aside + np.cos(angle) * ahead > 0)).all():
        raise InputError(
            f'the source does not see the whole panel from within: a radius of {radius:g} mm is too small, or the panel too wide'
        )
    return curve


def towards_source(rays: Rays) -> np.ndarray:
    """The panels' unit normals, [n, 3]."""
    normal = np.cross(rays.u, rays.v)
    normal *= np.sign(np.sum(normal * (rays.source - rays.corner), 1, keepdims=True))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)
