"""The geometry file of a scan, in YAML: TIGRE's names, lengths in mm, angles in degrees.

    DSO, DSD               distances from the source to the axis and to the panel (not needed for a parallel
                           beam)
    nDetector              pixels (v, u)
    dDetector / sDetector  size of a pixel / of the panel (v, u), either
    nVoxel                 voxels (x, y, z)
    dVoxel / sVoxel        size of a voxel / of the volume (x, y, z), either
    angles                 a list; or totalAngle (360) and startAngle (0): n angles evenly spaced, the end
                           excluded
    mode, offOrigin, offDetector   optional: cone or parallel; (x, y, z); TIGRE's (v, u), positive v towards
                                   +z
    rotDetector, COR, tilt, pitch, z   optional: a panel turned by (roll, pitch, yaw), an axis off centre, a source
                           lifted out of the plane of rotation, a helix by mm a turn (at z = 0 for the angle 0) or by
                           the height of every view (angles in degrees;
                           `lingo_mi.geometry.trajectories.scanner_rays` defines them)
    poses                  instead of DSO, DSD, angles and the offsets: a list of 12 numbers a view, ASTRA's vectors, or the
                           name of a file beside this one (`lingo_mi.files.poses`). Poses in RTK's .xml reverse the rows of
                           the .npy, which run up in RTK's images
    radius                 of a panel that is bent on a cylinder, mm: DSD if its axis passes through the focal spot.
                           dDetector is then a pixel's height and width along the arc, offDetector's second number a shift along
                           the arc; poses say where the panel's middle is, and u and v there
    valid                  name of a .npy beside this one, bool [n, v, u] or [v, u]: pixels to use. Others may hold anything
    dataset                name of the dataset [n, v, u] in an HDF5 file (default: /exchange/data, of Data Exchange)
    history                how the projections were made, for people: `lingo-mi import` writes it
    input                  line_integral (default) or intensity, which needs I0, the unattenuated intensity

DSO, DSD, offDetector, offOrigin (TIGRE's: it moves the object), rotDetector, COR and tilt may be lists of one
value for every view; an angle may be three, TIGRE's Euler angles.

Any other name is refused, so that a misspelt or unsupported one is noticed. TIGRE's accuracy and filter do not
describe the scanner and are ignored.
"""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.parsing import nearest
from lingo_mi.files import arrays, plain_yaml
from lingo_mi.files.poses import read_poses
from lingo_mi.files.scanner_dict import MOTION, from_geometry, of_grid, to_geometry, to_posed
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry, astra
from lingo_mi.geometry.trajectories import circular
from lingo_mi.storage.file_access import beside

_KEYS = {
    'DSO',
    'DSD',
    'nDetector',
    'dDetector',
    'sDetector',
    'nVoxel',
    'dVoxel',
    'sVoxel',
    'mode',
    'offOrigin',
    'offDetector',
    'angles',
    'totalAngle',
    'startAngle',
    'input',
    'I0',
    'test_angles',
    'accuracy',
    'filter',
    'poses',
    'test_poses',
    'radius',
    'valid',
    'dataset',
    'history',
    *MOTION,
}


def load_yaml(path: PathLike | str) -> dict:
    """The names of a geometry file.

    Raises
    ------
    InputError
        If it is missing, damaged, or has others.
    """
    values = plain_yaml.read_yaml(path)
    if not isinstance(values, dict):
        raise InputError(f'{path}: must hold the scan geometry as "name: value" lines')
    unknown = sorted(str(key) for key in values.keys() - _KEYS)
    if unknown:
        raise InputError(
            f'{path}: {unknown[0]} is not a name of the scan geometry or not '
            f"supported{nearest(unknown[0], _KEYS)}; the names are TIGRE's, see docs/how_to/own_projections.md"
        )
    return values


def _number(values, key, default, where):
    value = values.get(key, default)
    try:
        number = float(value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else math.nan
    except (OverflowError, ValueError):  # YAML takes 1e3 for text
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f'{where}: {key} must be one number, not {shown(value)}')
    return number


def posed_geometry(values: dict, n: int, where: PathLike | str, test: bool = False) -> Geometry:
    """The geometry of the n views to fit, or of those held out, from the names of a geometry file."""
    prefix = 'test_' if test else ''
    poses = values.get(prefix + 'poses')
    if poses is None:
        flat = to_geometry(values, _angles(values, prefix + 'angles', n, where), where)
        return _bent(flat, values, where, lambda radius: flat.curved(radius))

    def views(n_detector, step, parallel, origin):
        if isinstance(poses, str):
            rays = read_poses(beside(where, poses), n_detector, step, parallel, origin)
        else:
            rays = astra.from_vectors(poses, n_detector, parallel)
        if len(rays) != n:
            raise InputError(f'{prefix}poses are {len(rays)} views, but there are {n} projections; these must agree')
        return rays

    flat = to_posed(values, views, where)
    return _bent(flat, values, where, lambda radius: CurvedGeometry(flat=flat, radius=radius))


def _bent(geometry, values, where, curved):
    """The scan with its panel bent by the radius of `values`, or as it is."""
    if values.get('radius') is None:
        return geometry
    try:
        if isinstance(geometry, CurvedGeometry):
            raise InputError('radius and poses both bend the panel; remove radius')
        return curved(_number(values, 'radius', None, where))
    except InputError as error:
        raise error if str(error).startswith(str(where)) else InputError(f'{where}: {error}') from None


def _angles(values, key, n, where):
    """n angles in radians, or [n, 3] Euler angles."""
    if values.get(key) is None:
        return circular(n, _number(values, 'totalAngle', 360.0, where), _number(values, 'startAngle', 0.0, where))
    try:
        angles = np.radians(np.asarray(values[key], float))
    except (TypeError, ValueError, OverflowError):
        raise InputError(f'{where}: {key} must be a list of numbers, in degrees') from None
    if angles.shape not in ((n,), (n, 3)):
        raise InputError(
            f'{where}: {key} lists {len(angles) if angles.ndim else 1} angles, but there are {n} '
            'projections; these must agree'
        )
    return angles


def valid_mask(values, shape, where):
    """The mask of valid pixels that a geometry file names; None if it names none."""
    name = values.get('valid')
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f'{where}: valid must be the name of a .npy file, not {shown(name)}')
    path = beside(where, name)
    mask = arrays.read_npy(path, None)
    if mask.dtype != bool or mask.shape not in (shape, shape[1:]):
        raise InputError(
            f'{path}: must be bool of the shape {shape} or {shape[1:]}, not {mask.dtype} of the shape {mask.shape}'
        )
    return np.broadcast_to(mask, shape)


def line_integrals(projections, values, where, projections_path):
    kind = values.get('input', 'line_integral')
    if kind not in ('line_integral', 'intensity'):
        raise InputError(f'{where}: input must be line_integral or intensity, not {shown(kind)}')
    if kind == 'line_integral':
        return projections
    if values.get('I0') is None:
        raise InputError(f'{where}: input: intensity needs I0, the intensity without an object; add it')
    i0 = _number(values, 'I0', None, where)
    if i0 <= 0:
        raise InputError(f'{where}: I0 must be positive, not {i0:g}')
    if not projections.min() > 0:
        bad = tuple(int(i) for i in np.argwhere(~(projections > 0))[0])
        raise InputError(
            f'{projections_path}: an intensity is not positive (first at [view, v, u] = {bad}), '
            'so it has no logarithm; mask or repair dead pixels first'
        )
    out = np.empty(projections.shape, np.float32)
    for i, view in enumerate(projections):  # one by one, for memory
        out[i] = np.log(i0 / view.astype(float))
    return out


def dump_geometry(path, geometry, test=None, *, poses=None, **more):
    """Writes a geometry file. poses: the name of a file that holds them; None: they are lines of this one."""
    bend = {'radius': geometry.radius} if isinstance(geometry, CurvedGeometry) else {}
    flat = flat_panel(geometry)
    if isinstance(flat, CircularGeometry) and on_circle(geometry) and (test is None or on_circle(test)):
        values = {**from_geometry(flat), 'angles': np.degrees(geometry.angles).tolist()}
        if test is not None:
            values['test_angles'] = np.degrees(test.angles).tolist()
    else:
        values = {'mode': geometry.mode, 'nDetector': list(geometry.nDetector), **of_grid(geometry.grid)}
        values['poses'] = poses or astra.to_vectors(flat.rays(), geometry.nDetector).tolist()
        if test is not None:
            values['test_poses'] = astra.to_vectors(flat_panel(test).rays(), test.nDetector).tolist()
    values |= bend | more
    path.write_text(yaml.safe_dump(values, sort_keys=False, default_flow_style=None), encoding='utf-8')


def flat_panel(geometry):
    """The scan with the flat panel that a curved one touches along its middle; one with a flat panel as it is."""
    return geometry.flat if isinstance(geometry, CurvedGeometry) else geometry


def on_circle(geometry):
    """Return whether a circle's numbers describe a scan. A curved panel off the central ray is turned, too."""
    flat = flat_panel(geometry)
    return isinstance(flat, CircularGeometry) and (flat is geometry or not flat.offDetector[1])


def geometry_file_of(path: Path, geometry: PathLike | str | None = None) -> Any:
    """The geometry file of an .npy: the one that is named, else one beside it.

    Raises
    ------
    InputError
        If there is none.
    """
    if geometry is not None:
        return geometry
    if not has_geometry_file(path):
        raise InputError(
            f'{path}: needs its scan geometry; put it in {path.with_suffix(".yml").name} beside it or name the file'
        )
    return next(file for file in _beside(path) if file.exists())


def has_geometry_file(path: Path) -> bool:
    """Return whether a geometry file lies beside an array."""
    return any(file.exists() for file in _beside(path))


def _beside(path):
    return [path.with_suffix(suffix) for suffix in ('.yml', '.yaml')]


def rows_run_up(values: dict, name: str = 'poses') -> bool:
    """Return whether the rows of the projections run up that belong to a geometry file's values. RTK's rows run up; this
    package's rows run down."""
    return str(values.get(name)).lower().endswith('.xml')


def array_values(geometry):
    """The names of a geometry file that goes with one array."""
    values = load_yaml(geometry)
    for name in ('test_angles', 'test_poses'):
        if values.get(name) is not None:
            raise InputError(
                f'{geometry}: {name} goes with a folder of EXR views; an array holds the views to fit alone'
            )
    return values


def named_files(geometry: PathLike | str) -> list[Path]:
    """The files that a geometry file, .yml, names.

    Raises
    ------
    InputError
        As `load_yaml`.
    """
    values = load_yaml(geometry)
    names = (values.get(key) for key in ('poses', 'test_poses', 'valid'))
    return [beside(geometry, name) for name in names if isinstance(name, str)]
