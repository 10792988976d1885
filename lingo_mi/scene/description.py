"""A scanner as the parameters of the plugin `ct_scanner`: read into a geometry, and written from one."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files.poses import read_poses
from lingo_mi.files.scanner_dict import to_posed
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry, PosedGeometry, astra
from lingo_mi.geometry.grid import Grid, grid_of
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.geometry.trajectories import circular, helix
from lingo_mi.scene.data_files import data_file

T = TypeVar('T', str, int, float)
NAMES = (
    'mode',
    'DSO',
    'DSD',
    'nDetector',
    'dDetector',
    'offDetector',
    'nVoxel',
    'dVoxel',
    'offOrigin',
    'views',
    'totalAngle',
    'startAngle',
    'angles',
    'test_views',
    'pitch',
    'tilt',
    'rotDetector',
    'poses',
    'radius',
)
_CIRCLE = (
    'DSO',
    'DSD',
    'offDetector',
    'angles',
    'views',
    'totalAngle',
    'startAngle',
    'pitch',
    'tilt',
    'rotDetector',
    'test_views',
)


def describe(geometry: Geometry, index: int = 0) -> dict:
    """A `ct_scanner` as a dictionary for `mi.load_dict`."""

    def join(values):
        return ', '.join(repr(float(x)) if isinstance(x, float) else str(x) for x in values)

    shared = dict(
        type='ct_scanner',
        mode=geometry.mode,
        nDetector=join(geometry.nDetector),
        nVoxel=join(geometry.grid.shape),
        dVoxel=join(geometry.grid.spacing),
        offOrigin=join(geometry.grid.centre),
        view=index,
    )
    if isinstance(geometry, CurvedGeometry):
        shared, geometry = shared | dict(radius=geometry.radius), geometry.flat
        if (
            isinstance(geometry, CircularGeometry) and geometry.offDetector[1]
        ):  # which would move the panel along its arc
            geometry = PosedGeometry(poses=geometry.rays(), nDetector=geometry.nDetector, grid=geometry.grid)
    if not isinstance(geometry, CircularGeometry):
        vectors = astra.to_vectors(geometry.rays(), geometry.nDetector)
        return shared | dict(poses=join(vectors.ravel().tolist()))
    return shared | dict(
        DSO=geometry.DSO,
        DSD=geometry.DSD,
        dDetector=join(geometry.dDetector),
        offDetector=join(geometry.offDetector),
        angles=join(np.degrees(geometry.angles).tolist()),
    )


def parameter(props: Any, name: str, default: T) -> T:
    """A property with the type of its default: a string, a whole number or a finite number."""
    value = props.get(name, default)
    kind, wanted = {str: (str, 'text'), int: (int, 'a whole number'), float: ((int, float), 'a number')}[type(default)]
    if not isinstance(value, kind) or isinstance(value, bool) or (wanted == 'a number' and not np.isfinite(value)):
        raise InputError(f'{name} must be {wanted}, not {shown(value)}')
    return value


def _numbers(props, name, default=None):
    value = props.get(name, default)
    if value is None:
        raise InputError(f'{name} is missing')
    try:
        return [float(x) for x in str(value).replace(',', ' ').split()]
    except ValueError:
        raise InputError(f'{name} = {shown(value)} is not a list of numbers') from None


def _distance(props, name, default):
    values = _numbers(props, name, default)
    if len(values) != 1:
        raise InputError(f'{name} must be one number, not {values}')
    return values[0]


def _counts(props, name):
    values = _numbers(props, name)
    if any(n % 1 != 0 for n in values):  # also of NaN and infinity
        raise InputError(f'{name} must be whole numbers, not {values}')
    return values


def grid_from(props: Any, grid: Grid) -> Grid:
    """The grid of a plugin's properties; `grid` gives what they do not name."""
    values: dict[str, Any] = dict(nVoxel=grid.shape, dVoxel=grid.spacing, offOrigin=grid.centre)
    if 'nVoxel' in props:
        values['nVoxel'] = _counts(props, 'nVoxel')
    return grid_of(values | {name: _numbers(props, name) for name in ('dVoxel', 'offOrigin') if name in props})


def read_scanner(props: Any) -> tuple[Geometry, Geometry | None]:
    """The scan's and the held-out views' geometry from a plugin's properties."""
    mode = parameter(props, 'mode', 'cone')
    shared: dict[str, Any] = dict(mode=mode, nDetector=_counts(props, 'nDetector'))
    voxels = dict(
        nVoxel=_counts(props, 'nVoxel'), dVoxel=_numbers(props, 'dVoxel'), offOrigin=_numbers(props, 'offOrigin', 0.0)
    )
    radius = _distance(props, 'radius', 0.0)
    if parameter(props, 'poses', ''):
        posed = _read_poses(props, shared | voxels)
        return CurvedGeometry(flat=posed, radius=radius) if radius else posed, None
    total, start = parameter(props, 'totalAngle', 360.0), parameter(props, 'startAngle', 0.0)
    views, held_out = parameter(props, 'views', 50), parameter(props, 'test_views', 0)
    if held_out < 0:
        raise InputError(f'test_views must not be negative, but is {held_out}')
    if max(views, held_out) > MOST_VIEWS:
        raise InputError(f'a scan has at most {MOST_VIEWS} views, not {max(views, held_out)}')
    angles = np.radians(_numbers(props, 'angles')) if 'angles' in props else circular(views, total, start)
    far = 1.0 if mode == 'parallel' else None  # a parallel beam has no source; the distances only place it
    shared |= dict(
        grid=grid_of(voxels),
        DSO=_distance(props, 'DSO', far),
        DSD=_distance(props, 'DSD', far),
        dDetector=_numbers(props, 'dDetector'),
        offDetector=_numbers(props, 'offDetector', 0.0),
    )
    pitch, tilt, turned = (
        parameter(props, 'pitch', 0.0),
        parameter(props, 'tilt', 0.0),
        _numbers(props, 'rotDetector', '0 0 0'),
    )
    if len(turned) != 3:
        raise InputError(f'rotDetector must be 3 angles (roll, pitch, yaw), not {turned}')

    def geometry(at):
        circle = CircularGeometry(angles=at, **shared)
        flat: Geometry = circle
        if pitch or tilt or any(turned):
            flat = Geometry.per_view(
                **circle.numbers(), height=helix(at, pitch), tilt=np.radians(tilt), rotDetector=np.radians(turned)
            )
        return flat.curved(radius) if radius else flat

    if not held_out:
        return geometry(angles), None
    if 'angles' in props and 'totalAngle' not in props and len(angles):
        start, total = np.degrees(angles.min()), np.degrees(np.ptp(angles))
    drawn = np.sort(total * np.random.default_rng(0).uniform(0, 1, held_out)) + start
    return geometry(angles), geometry(np.radians(drawn))


def _split_numbers(text: str) -> tuple[list[float], list[str]]:
    """The numbers in a text, and what else it holds between commas and spaces."""
    numbers, others = [], []
    for part in text.replace(',', ' ').split():
        try:
            numbers.append(float(part))
        except ValueError:
            others.append(part)
    return numbers, others


def _read_poses(props, shared):
    """A scan with a pose for every view."""
    circular_names = [name for name in _CIRCLE if name in props]
    if circular_names:
        raise InputError(f'{circular_names[0]} and poses both say which views there are; leave one of them out')
    values = {k: v for k, v in shared.items() if k != 'mode'}
    values |= {'dDetector': _numbers(props, 'dDetector')} if 'dDetector' in props else {}

    def views(n_detector, step, parallel, origin):
        poses = props['poses']
        numbers, wrong = _split_numbers(poses)
        if wrong and len(numbers) > len(wrong):
            raise InputError(f'poses must be 12 numbers for every view, or a file; {shown(wrong[0])} is not a number')
        if wrong:
            return read_poses(data_file(poses, 'poses'), n_detector, step, parallel, origin)
        if len(numbers) % 12:
            raise InputError(f'poses must be 12 numbers for every view, not {len(numbers)}')
        return astra.from_vectors(np.reshape(numbers, (-1, 12)), n_detector, parallel)

    return to_posed(values | {'mode': shared['mode']}, views, 'poses')
