"""RTK's geometry: its object, and its files, `RTKThreeDCircularGeometry` in XML, versions 2 and 3.

Every view has SourceToIsocenterDistance (SID), SourceToDetectorDistance (SDD; 0: a parallel beam), GantryAngle,
OutOfPlaneAngle and InPlaneAngle in degrees, ProjectionOffsetX and Y, SourceOffsetX and Y, in mm; what all views share may
stand before them. RTK's axes are (x, y, z) = (our y, our z, our x), and the view's own are

    (e1, e2, e3) = Ry(GantryAngle) Rx(OutOfPlaneAngle) Rz(InPlaneAngle)
    source       SourceOffsetX e1 + SourceOffsetY e2 + SID e3
    panel        (x + ProjectionOffsetX) e1 + (y + ProjectionOffsetY) e2 + (SID - SDD) e3

with x, y the position in the image of projections. The image's spacing and origin are not in the file: spacing is
dDetector, and the image is taken as centred, its origin at minus half of (pixels - 1) spacings. RTK's rows run up, this
package's down: the rows of RTK's stacks must be reversed, `stack[:, ::-1]`, to go with the poses read here.

RadiusCylindricalDetector, once for all views and 0 for flat panels, bends them towards the source: x + ProjectionOffsetX is then
a length along the arc, from the line of the panel where e3 through the axis of rotation meets it.

Rit et al., "The Reconstruction Toolkit (RTK)", J. Phys.: Conf. Ser. 489 (2014), and RTK's documentation, "Geometry".
"""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import limits
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.curved import bent, slid, towards_source
from lingo_mi.geometry.grid import Voxels
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import rotation
from lingo_mi.storage.file_access import one_line, reading, replacing

if TYPE_CHECKING:
    from typing_extensions import Unpack

ROOT = 'RTKThreeDCircularGeometry'
_NUMBERS = (
    'SourceToIsocenterDistance',
    'SourceToDetectorDistance',
    'GantryAngle',
    'OutOfPlaneAngle',
    'InPlaneAngle',
    'ProjectionOffsetX',
    'ProjectionOffsetY',
    'SourceOffsetX',
    'SourceOffsetY',
)
_ANGLES = slice(2, 5)  # of _NUMBERS
RADIUS = 'RadiusCylindricalDetector'
_IGNORED = ('Matrix', 'CollimationUInf', 'CollimationUSup', 'CollimationVInf', 'CollimationVSup')
_AXES = [2, 0, 1]  # our x, y, z in RTK's


def scan(
    source: str | PathLike | Any, *, nDetector: ArrayLike, dDetector: ArrayLike, **voxels: Unpack[Voxels]
) -> Geometry:
    """The scan that a geometry of RTK describes.

    RTK says neither the panel's pixels nor the voxels. Its images are taken as centred. RTK's axes (x, y, z) are this package's
    (y, z, x), and its rows run up: `stack[:, ::-1]` goes with the result.

    Parameters
    ----------
    source : path or itk.RTK.ThreeDCircularProjectionGeometry
        RTK's XML file, or its object.
    nDetector, dDetector
        Pixels and pixel size in mm, (v, u).
    **voxels
        Either grid, or nVoxel, dVoxel and offOrigin, as for `Geometry.cone`.

    Raises
    ------
    InputError
        If the file is missing, damaged or another one.

    Examples
    --------
    ::

        Geometry.from_rtk('geometry.xml', nDetector=256, dDetector=1.0, grid=Grid(128, 1.0))
    """
    nDetector, dDetector = limits.counts('nDetector', nDetector, 2), limits.sizes('dDetector', dDetector, 2)
    return Geometry.from_poses(read_rtk(source, nDetector, dDetector), nDetector, **voxels)


def read_rtk(source: Any, nDetector: tuple[int, int], dDetector: tuple[float, float]) -> Rays:
    """The views of RTK's geometry, in mm, rows down.

    Parameters
    ----------
    source
        The path of its XML file, or an `itk.RTK.ThreeDCircularProjectionGeometry`.
    nDetector, dDetector
        (v, u), pixels and mm.

    Raises
    ------
    InputError
        If the file is missing, damaged or another one, and for elements that are not known. The matrices, which follow from the
        numbers, and collimation are passed over.
    """
    where = source if isinstance(source, (str, PathLike)) else "RTK's geometry"
    columns, radius = _from_file(source) if where is source else _from_object(source)
    sid, sdd, gantry, out, turn, px, py, sx, sy = columns
    if not len(sid):
        raise InputError(f'{where}: holds no projections')
    parallel = not sdd.any()
    if not parallel and not (sdd > 0).all():
        raise InputError(
            f'{where}: mixes parallel and cone beams (SourceToDetectorDistance of 0 and not), or has a negative distance'
        )
    axes = rotation('y', gantry) @ rotation('x', out) @ rotation('z', turn)
    e1, e2, e3 = (axes[:, _AXES, i] for i in range(3))
    (nv, nu), (dv, du) = nDetector, dDetector
    x, y, z = (a[:, None] for a in (px - nu / 2 * du, py + nv / 2 * dv, sid - sdd if not parallel else 0 * sid))
    start = -e3 if parallel else sx[:, None] * e1 + sy[:, None] * e2 + sid[:, None] * e3
    try:
        rays = Rays(start, x * e1 + y * e2 + z * e3, du * e1, -dv * e2, parallel).checked()
        if not radius:
            return rays
        touching = replace(rays, corner=rays.corner - px[:, None] * e1)
        return bent(slid(touching, nDetector, radius, px), nDetector, radius)
    except InputError as error:
        raise InputError(f'{where}: {error}') from None


def write_rtk(path: PathLike | str, rays: Rays, nDetector: tuple[int, int]) -> None:
    """Writes views, rows down, as RTK's geometry for images whose rows run up, spaced like the panels and centred.

    Curved panels have one radius: `CurvedGeometry.rays` of `curved=True` are such.

    Raises
    ------
    InputError
        If RTK cannot say it: panels whose rows and columns are not at right angles or differ between views, mirrored ones, panels
        askew to a parallel beam; and if the file cannot be written.
    """
    step_u, step_v = (np.linalg.norm(a, axis=1) for a in (rays.u, rays.v))
    radius = 0.0 if rays.curve is None else float(np.mean(rays.curve.radius * step_u))
    if radius:
        rays = _facing_the_axis(rays, nDetector, radius)
    e1, e2 = rays.u / step_u[:, None], -rays.v / step_v[:, None]
    e3 = np.cross(e1, e2)
    if np.abs(np.sum(e1 * e2, 1)).max() > 1e-6:
        raise InputError(f'{path}: RTK has no panels whose rows and columns are not at right angles')
    if any(np.ptp(step) > 1e-6 * step.mean() for step in (step_u, step_v)):
        raise InputError(f'{path}: RTK has one pixel size for all views')
    centre = rays.centre(nDetector)
    zero = np.zeros(len(rays))
    if rays.parallel:
        if np.abs(np.cross(rays.source, e3)).max() > 1e-6:
            raise InputError(f'{path}: RTK has no panels askew to a parallel beam')
        sid, sdd, sx, sy = np.full(len(rays), 1000.0), zero, zero, zero
    else:
        sx, sy, sid = (np.sum(rays.source * e, 1) for e in (e1, e2, e3))
        sdd = sid - np.sum(centre * e3, 1)
    if (np.sum(rays.source * e3, 1) > 0 if rays.parallel else sdd <= 0).any():
        raise InputError(f'{path}: RTK has no mirrored panels')
    axes = np.stack([e[:, [1, 2, 0]] for e in (e1, e2, e3)], -1)
    gantry, out, turn = Rotation.from_matrix(axes).as_euler('YXZ', degrees=True).T
    px, py = (np.sum(centre * e, 1) for e in (e1, e2))
    columns = dict(zip(_NUMBERS, (sid, sdd, np.mod(gantry, 360), out, turn, px, py, sx, sy)))
    root = ElementTree.Element(ROOT, version='3')
    if radius:
        ElementTree.SubElement(root, RADIUS).text = repr(radius)
    for view, matrix in enumerate(_matrices(rays, nDetector, sdd, step_u, step_v)):
        node = ElementTree.SubElement(root, 'Projection')
        for name, values in columns.items():
            ElementTree.SubElement(node, name).text = repr(float(values[view]))
        ElementTree.SubElement(node, 'Matrix').text = (
            '\n' + '\n'.join(' '.join(repr(float(x)) for x in row) for row in matrix) + '\n'
        )
    ElementTree.indent(root)
    text = '<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'
    with replacing(path) as temporary:
        temporary.write_text(text, encoding='utf-8')


def _facing_the_axis(rays: Rays, nDetector, radius) -> Rays:
    """Flat panels that touch the same cylinders where RTK's do, moved in their planes by what the panel's middle is off there."""
    along, up = rays.u / np.linalg.norm(rays.u, axis=1, keepdims=True), towards_source(rays)
    axis = rays.centre(nDetector) + radius * up
    aside, ahead = (np.sum(axis * a, 1) for a in (along, up))
    by = radius * np.arctan2(-aside * np.where(ahead < 0, -1, 1), np.abs(ahead))
    there = slid(rays, nDetector, radius, by)
    step = there.u / np.linalg.norm(there.u, axis=1, keepdims=True)
    return replace(there, corner=there.corner - by[:, None] * step)


def _from_file(path) -> tuple[np.ndarray, float]:
    """The columns of `_NUMBERS` of all views, [9, n], angles in radians, and the radius of the panel, 0 if it is flat."""
    views = [[view[name] for name in (*_NUMBERS, RADIUS)] for view in _views(path)]
    *columns, radius = np.array(views, float).reshape(-1, len(_NUMBERS) + 1).T
    columns = np.array(columns)
    columns[_ANGLES] = np.radians(columns[_ANGLES])
    if len(set(radius)) > 1:
        raise InputError(f'{path}: {RADIUS} must be the same for all views')
    return columns, float(radius[0]) if len(radius) else 0.0


def _from_object(geometry) -> tuple[np.ndarray, float]:
    """The same of RTK's object, which keeps its angles in radians."""
    plural = [name + 's' if not name.endswith(('X', 'Y')) else f'{name[:-1]}s{name[-1]}' for name in _NUMBERS]
    columns = np.array([getattr(geometry, 'Get' + name)() for name in plural], float)
    return columns, float(geometry.GetRadiusCylindricalDetector())


def _views(path):
    """Numbers of every view by name, with those that all views share."""
    try:
        with reading(path):
            text = Path(path).read_text(encoding='utf-8')
        if '<!ENTITY' in text:  # an entity may stand for many others
            raise InputError(f'{path}: defines entities, which no geometry of RTK needs; remove them')
        parser, depth = ElementTree.XMLPullParser(('start', 'end')), 0
        parser.feed(text)
        for event in parser.read_events():
            depth += 1 if event[0] == 'start' else -1
            if depth > 3:
                raise InputError(f'{path}: is not {ROOT}: it is nested more than 3 deep')
        root = ElementTree.fromstring(text)
    except InputError:
        raise
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f'{path}: is not XML ({one_line(error)})') from None
    if root.tag != ROOT or root.get('version') not in ('2', '3'):
        raise InputError(f'{path}: is not {ROOT} of version 2 or 3')
    shared = dict.fromkeys((*_NUMBERS, RADIUS), 0.0)
    for node in root:
        if node.tag != 'Projection':
            shared.update(_number(node, path))
    for node in root:
        if node.tag == 'Projection':
            view = dict(shared)
            for item in node:
                view.update(_number(item, path))
            yield view


def _number(node, path) -> dict:
    if node.tag in _IGNORED:
        return {}
    try:
        value = float(node.text)
        if not np.isfinite(value):
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f'{path}: {node.tag} must be a finite number, not {shown(node.text)}') from None
    if node.tag not in (*_NUMBERS, RADIUS):
        raise InputError(f'{path}: {node.tag} = {value:g} is not supported')
    return {node.tag: value}


def _matrices(rays, nDetector, sdd, step_u, step_v):
    """RTK's own matrices: from RTK's (x, y, z, 1) to the image's position in mm, times the negative distance."""
    to_mm = np.zeros((len(rays), 3, 3))
    to_mm[:, 0, 0], to_mm[:, 0, 2] = step_u, -nDetector[1] / 2 * step_u
    to_mm[:, 1, 1], to_mm[:, 1, 2] = -step_v, nDetector[0] / 2 * step_v
    to_mm[:, 2, 2] = 1
    scale = np.ones(len(rays)) if rays.parallel else -sdd
    return scale[:, None, None] * (to_mm @ camera_matrices(rays))[:, :, [1, 2, 0, 3]]
