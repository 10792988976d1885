"""Scans of the ASTRA toolbox: its dicts, and poses as its vectors, 12 numbers a view.

- `cone_vec`: source, panel's centre, u, v
- `parallel3d_vec`: direction of the beam, panel's centre, u, v
- `cyl_cone_vec` (ASTRA 2.4 and later): source, centre of a panel that is bent on a cylinder, u and v there, and its radius: 13
  numbers. Seen along - u x v, the panel lies behind the cylinder's axis

each (x, y, z), u and v one pixel long: from pixel (0, 0) to its neighbour in the row, and in the column. ASTRA's world is
this package's, in mm. Its arrays are [v, view, u] and volumes [z, y, x]: transpose them. `to_vectors` and `from_vectors` assume
nothing about where a row lies: vectors made by ASTRA's own `geom_2vec` have v along +z, this package's scanners v along -z, and
both mean the same as long as they stay with their projections. `circle` and `views` reverse ASTRA's rows, so that its scanners
are this package's.

A geometry of two dimensions, `fanflat`, `parallel`, or their vectors (source or ray, centre, u), has a panel of one row
before a volume of one slice at z = 0: `sinogram[:, None]` goes with it. ASTRA's image is then `volume[:, ::-1, 0].T`, its first
row at the largest y. `to_vectors(rays, (1, columns))[:, [0, 1, 3, 4, 6, 7]]` are the vectors of two dimensions.

ASTRA documentation, "2D geometries" and "3D geometries"; `astra.functions.geom_2vec` and `astra.create_vol_geom`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import limits
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.circle import CircularGeometry
from lingo_mi.geometry.curved import CurvedGeometry, bent
from lingo_mi.geometry.grid import Grid, Voxels, grid_of
from lingo_mi.geometry.rays import Rays

if TYPE_CHECKING:
    from typing_extensions import Unpack

CIRCLES = {'cone': 'cone', 'parallel3d': 'parallel'}  # ASTRA's types of scans on a circle, and their beams
VECTORS = {
    'cone_vec': 'cone',
    'parallel3d_vec': 'parallel',
    'cyl_cone_vec': 'cone',
}  # of scans with a pose for every view
# Types of two dimensions, and the same types in three dimensions with one row.
IN_PLANE = {'fanflat': 'cone', 'parallel': 'parallel3d', 'fanflat_vec': 'cone_vec', 'parallel_vec': 'parallel3d_vec'}


def scan(proj_geom: dict, vol_geom: dict | None = None, **voxels: Unpack[Voxels]) -> Geometry:
    """The scan that geometries of the ASTRA toolbox describe.

    ASTRA's arrays are [v, view, u] with rows that run up, and volumes [z, y, x]: `sinogram.transpose(1, 0, 2)[:, ::-1]` and
    `volume.T` go with the result.

    Parameters
    ----------
    proj_geom : dict
        Geometry of the type 'cone', 'cone_vec', 'cyl_cone_vec', 'parallel3d' or 'parallel3d_vec', or in two dimensions 'fanflat',
        'fanflat_vec', 'parallel' or 'parallel_vec'; lengths as they are.
    vol_geom : dict
        Geometry by `astra.create_vol_geom`. In two dimensions, its slice is as thick as a pixel is wide.
    **voxels
        Instead of vol_geom: either grid, or nVoxel, dVoxel and offOrigin, as for `Geometry.cone`.

    Raises
    ------
    InputError
        For other types, and if a number is missing or makes no scan.

    Examples
    --------
    ::

        proj = astra.create_proj_geom('cone', 1.0, 1.0, 256, 256, np.linspace(0, 2 * np.pi, 90, False), 1000, 500)
        Geometry.from_astra(proj, astra.create_vol_geom(128, 128, 128))
    """
    if (vol_geom is None) == (not voxels):
        raise InputError('an ASTRA geometry needs its voxels: give either vol_geom, or grid, or both nVoxel and dVoxel')
    proj_geom = in_space(proj_geom)
    voxel_grid = grid_of(voxels) if vol_geom is None else grid(vol_geom)
    if kind_of(proj_geom) in CIRCLES:
        return CircularGeometry(**circle(proj_geom), grid=voxel_grid)
    rays, nDetector = pose_rays(proj_geom)
    return Geometry.from_poses(rays, nDetector, grid=voxel_grid)


def to_vectors(rays: Rays, nDetector: tuple[int, int]) -> np.ndarray:
    """ASTRA's vectors of the views, float64 [n, 12]; nDetector is (v, u) pixels."""
    return np.concatenate([rays.source, rays.centre(nDetector), rays.u, rays.v], 1)


def from_vectors(vectors: ArrayLike, nDetector: tuple[int, int], parallel: bool) -> Rays:
    """The views of ASTRA's vectors [n, 12]; nDetector is (v, u) pixels. InputError if they are not poses."""
    vectors = limits.lengths('poses', vectors)
    if vectors.ndim != 2 or vectors.shape[1] != 12 or not len(vectors):
        raise InputError(
            f'poses must be 12 numbers for every view (source, centre of the panel, u, v), not an array of '
            f'shape {vectors.shape}'
        )
    source, centre, u, v = vectors[:, :3], vectors[:, 3:6], vectors[:, 6:9], vectors[:, 9:]
    corner = centre - nDetector[1] / 2 * u - nDetector[0] / 2 * v
    return Rays(source, corner, u, v, parallel).checked()


def to_cylinder_vectors(geometry: CurvedGeometry) -> np.ndarray:
    """ASTRA's vectors of the views of a curved panel for its `cyl_cone_vec`, float64 [n, 13].

    ASTRA's rows run up: `projections[:, ::-1].transpose(1, 0, 2)` goes with them.

    Examples
    --------
    ::

        rows, columns = geometry.nDetector
        astra.create_proj_geom('cyl_cone_vec', rows, columns, to_cylinder_vectors(geometry))
    """
    rays = geometry.flat.rays()
    vectors = to_vectors(
        replace(rays, corner=rays.corner + geometry.nDetector[0] * rays.v, v=-rays.v), geometry.nDetector
    )
    if not _bent_towards_source(replace(rays, v=-rays.v)).all():
        raise InputError('ASTRA has no curved panel whose columns run the other way: reverse u and the columns')
    return np.concatenate([vectors, np.full((len(rays), 1), geometry.radius)], 1)


def _bent_towards_source(rays):
    """Return whether ASTRA bends the panels of its `rays` towards their sources, [n]."""
    return np.sum(np.cross(rays.u, rays.v) * (rays.source - rays.corner), 1) > 0


def in_space(proj_geom: dict) -> dict:
    """A dict of three dimensions: of a panel of one row, as high as a pixel is wide, if it has two.

    Raises
    ------
    InputError
        If a number is missing, or the vectors are not poses.
    """
    kind = kind_of(proj_geom)
    if kind not in IN_PLANE:
        return proj_geom
    flat = dict(type=IN_PLANE[kind], DetectorRowCount=1, DetectorColCount=_number(proj_geom, 'DetectorCount'))
    if not kind.endswith('_vec'):
        width = _number(proj_geom, 'DetectorWidth')
        return {**proj_geom, **flat, 'DetectorSpacingX': width, 'DetectorSpacingY': width}
    vectors = limits.lengths('Vectors', _value_of(proj_geom, 'Vectors'))
    if vectors.ndim != 2 or vectors.shape[1] != 6:
        raise InputError(
            f'the Vectors of {kind} must be 6 numbers for every view, not an array of shape {vectors.shape}'
        )
    out = np.zeros((len(vectors), 12))
    out[:, [0, 1, 3, 4, 6, 7]] = vectors
    out[:, 11] = np.linalg.norm(vectors[:, 4:], axis=1)
    return {**flat, 'Vectors': out}


def circle(proj_geom: dict) -> dict[str, Any]:
    """The scanner of a dict of the types `CIRCLES`, as the numbers of a `CircularGeometry`; ASTRA's rows reversed.

    Raises
    ------
    InputError
        If a number is missing.
    """
    mode = CIRCLES[proj_geom['type']]
    DSO, to_panel = (
        _number(proj_geom, 'DistanceOrigin' + of) if mode == 'cone' else 0.0 for of in ('Source', 'Detector')
    )
    return dict(
        mode=mode,
        DSO=DSO,
        DSD=DSO + to_panel,
        nDetector=_panel(proj_geom),
        dDetector=(_number(proj_geom, 'DetectorSpacingY'), _number(proj_geom, 'DetectorSpacingX')),
        # ASTRA's source is at DSO (sin a, -cos a, 0).
        angles=limits.angles('ProjectionAngles', _value_of(proj_geom, 'ProjectionAngles')) - np.pi / 2,
    )


def pose_rays(proj_geom: dict) -> tuple[Rays, tuple[int, int]]:
    """The views of a dict of the types `VECTORS`, ASTRA's rows reversed, and the panel's pixels (v, u).

    The beam of a parallel scan is taken to come from in front of its panel; its line integrals know no direction.

    Raises
    ------
    InputError
        If the type is another one, a number is missing, or the vectors are not poses.
    """
    kind = kind_of(proj_geom)
    if kind not in VECTORS:
        types = ', '.join(CIRCLES | VECTORS | IN_PLANE)
        raise InputError(f'an ASTRA geometry must be of the type {types}, not {shown(kind)}')
    nDetector, vectors, radius = _panel(proj_geom), _value_of(proj_geom, 'Vectors'), None
    if kind == 'cyl_cone_vec':
        vectors = limits.lengths('Vectors', vectors)
        if vectors.ndim != 2 or vectors.shape[1] != 13 or len(set(vectors[:, 12])) != 1:
            raise InputError(
                'the Vectors of cyl_cone_vec must be 13 numbers for every view, the last of them, a radius, the same for all'
            )
        vectors, radius = vectors[:, :12], float(vectors[0, 12])
    rays = from_vectors(vectors, nDetector, VECTORS[kind] == 'parallel')
    if radius is not None and not _bent_towards_source(rays).all():
        raise InputError('a panel of cyl_cone_vec is bent away from its source: swap the sign of u or of v')
    source, v = rays.source, -rays.v
    if rays.parallel:
        source = source * np.sign(np.sum(source * np.cross(rays.u, v), 1, keepdims=True))
    down = Rays(source, rays.corner - nDetector[0] * v, rays.u, v, rays.parallel)
    return down if radius is None else bent(down, nDetector, radius), nDetector


def grid(vol_geom: dict) -> Grid:
    """The voxels of a dict of `astra.create_vol_geom`.

    Raises
    ------
    InputError
        If a number is missing or makes no grid.
    """
    window = _value_of(vol_geom, 'option')
    if 'GridSliceCount' not in vol_geom:  # of two dimensions
        half = (_number(window, 'WindowMaxX') - _number(window, 'WindowMinX')) / _number(vol_geom, 'GridColCount') / 2
        vol_geom, window = {**vol_geom, 'GridSliceCount': 1}, {**window, 'WindowMinZ': -half, 'WindowMaxZ': half}
    counts = np.array([_number(vol_geom, f'Grid{name}Count') for name in ('Col', 'Row', 'Slice')])
    low, high = (np.array([_number(window, f'Window{end}{axis}') for axis in 'XYZ']) for end in ('Min', 'Max'))
    if not np.all(counts >= 1):
        raise InputError(f'the counts of an ASTRA volume must be positive, not {shown(counts.tolist())}')
    return Grid(counts, (high - low) / counts, (low + high) / 2)


def kind_of(proj_geom: dict) -> str:
    """The type of a dict of ASTRA, empty if it has none.

    Raises
    ------
    InputError
        If this is not a dict or a text.
    """
    kind = proj_geom.get('type', '') if isinstance(proj_geom, Mapping) else None
    if not isinstance(kind, str):
        raise InputError(f'an ASTRA geometry must be a dict with a type, not {shown(proj_geom)}')
    return kind


def _panel(proj_geom) -> tuple[int, int]:
    return int(_number(proj_geom, 'DetectorRowCount')), int(_number(proj_geom, 'DetectorColCount'))


def _number(values: dict, name: str) -> float:
    value = limits.lengths(name, _value_of(values, name))
    if value.ndim:
        raise InputError(f'{name} of the ASTRA geometry must be one number, not {shown(value)}')
    return float(value)


def _value_of(values: dict, name: str):
    if not isinstance(values, Mapping) or name not in values:
        raise InputError(f'the ASTRA geometry has no {name}')
    return values[name]
