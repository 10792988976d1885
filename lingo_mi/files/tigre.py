"""Scan geometry as a dictionary under TIGRE's names: the common ground of the pickle, the R2 folder and the
YAML file."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..geometry import Geometry
from ..scan import Dataset, Scan


def _numbers(values: dict, name: str, where, length: int):
    try:
        array = np.asarray(values[name], float).ravel()
    except (TypeError, ValueError):
        raise InputError(f'{where}: {name} must be numbers, not {values[name]!r}') from None
    if array.size not in (1, length):
        raise InputError(f'{where}: {name} must be {length} numbers, not {values[name]!r}')
    return np.broadcast_to(array, length)


def _counts(values, name, where, length):
    if values.get(name) is None:
        raise InputError(f'{where}: {name} is missing; add it')
    array = _numbers(values, name, where, length)
    if not np.array_equal(array, np.round(array)):
        raise InputError(f'{where}: {name} must be whole numbers, not {values[name]!r}')
    return array


def _steps(values, kind, counts, where):
    """d = s / n: either may be given; both must agree."""
    step, side = (values.get(p + kind) is not None for p in 'ds')
    if not step and not side:
        raise InputError(f'{where}: neither d{kind} nor s{kind} is given; add one of them')
    from_side = _numbers(values, 's' + kind, where, len(counts)) / np.maximum(counts, 1) if side else None
    if not step:
        return from_side
    d = _numbers(values, 'd' + kind, where, len(counts))
    if side and not np.allclose(d, from_side, rtol=1e-3, atol=0):
        raise InputError(f'{where}: d{kind} and s{kind} disagree (s{kind} = n{kind} * d{kind}); remove one '
                         'of them')
    return d


def to_geometry(values: dict, angles, where, *, detector_shape=None, offset_order: str = 'vu') -> Geometry:
    """A Geometry from TIGRE's names.

    values           DSO, DSD, nDetector, dDetector or sDetector in (v, u), nVoxel, dVoxel or sVoxel in (x, y,
                     z); optional: mode, offOrigin (x, y, z), offDetector; all lengths in mm
    angles           [n] radians
    where            the file, for messages
    detector_shape   (v, u) pixels of the projections; if nDetector has these the other way round, nDetector
                     and the panel's size are taken as (u, v)
    offset_order     'vu' (TIGRE) or 'uv' (NAF and R2-Gaussian, which hand it to TIGRE reversed)

    Raises InputError where a value is missing, contradictory or out of range.
    """
    values = dict(values)
    n_detector = _counts(values, 'nDetector', where, 2)
    d_detector = _steps(values, 'Detector', n_detector, where)
    if detector_shape is not None and tuple(n_detector) != tuple(detector_shape):
        if tuple(n_detector[::-1]) != tuple(detector_shape):
            raise InputError(f'{where}: nDetector = {[int(n) for n in n_detector]} does not match the '
                             f'projections, which have {detector_shape[0]} rows and {detector_shape[1]} '
                             'columns; correct nDetector')
        n_detector, d_detector = n_detector[::-1], d_detector[::-1]
    n_voxel = _counts(values, 'nVoxel', where, 3)
    mode = values.get('mode') or 'cone'
    for name in ('DSO', 'DSD'):
        if values.get(name) is None:
            if mode != 'parallel':
                raise InputError(f'{where}: {name} is missing; add the distance from the source, in mm')
            values[name] = 0.  # places the panel on the axis, where a parallel beam does not care
    origin, offset = (np.zeros(length) if values.get(name) is None else _numbers(values, name, where, length)
                      for name, length in (('offOrigin', 3), ('offDetector', 2)))
    try:
        return Geometry(
            DSO=float(_numbers(values, 'DSO', where, 1)[0]), DSD=float(_numbers(values, 'DSD', where, 1)[0]),
            nDetector=n_detector, dDetector=d_detector,
            nVoxel=n_voxel, dVoxel=_steps(values, 'Voxel', n_voxel, where), angles=angles, mode=mode,
            offOrigin=origin, offDetector=offset[::-1] if offset_order == 'uv' else offset)
    except InputError as error:
        raise error if str(error).startswith(str(where)) else InputError(f'{where}: {error}') from None


def from_geometry(geometry: Geometry, offset_order: str = 'vu') -> dict:
    """The inverse of `to_geometry` without the angles: plain floats, ints and lists, mm."""
    offset = geometry.offDetector[::-1] if offset_order == 'uv' else geometry.offDetector
    return {
        'mode': geometry.mode, 'DSD': geometry.DSD, 'DSO': geometry.DSO,
        'nDetector': list(geometry.nDetector), 'dDetector': list(geometry.dDetector),
        'nVoxel': list(geometry.nVoxel), 'dVoxel': list(geometry.dVoxel),
        'offOrigin': list(geometry.offOrigin), 'offDetector': list(offset),
    }


def angle_range(angles: np.ndarray) -> tuple[float, float]:
    """(startAngle, totalAngle) in degrees, as if `angles` (radians) were evenly spaced; formats that list the
    angles carry these two for information only."""
    low, high, n = np.degrees(angles.min()), np.degrees(angles.max()), len(angles)
    return float(low), float((high - low) * n / (n - 1)) if n > 1 else 360.


def make_scan(geometry: Geometry, projections, where) -> Scan:
    """A Scan whose InputError names the file."""
    try:
        return Scan(geometry, projections)
    except InputError as error:
        raise InputError(f'{where}: {error}') from None


def make_dataset(train: Scan, test: Scan | None, volume, where) -> Dataset:
    """A Dataset with a float32 volume, after a check that the volume [x, y, z] has nVoxel voxels."""
    if volume is not None:
        if volume.shape != train.geometry.nVoxel:
            raise InputError(f'{where}: the volume has the shape {volume.shape}, but nVoxel is '
                             f'{train.geometry.nVoxel}; volumes are stored [x, y, z]')
        volume = np.asarray(volume, np.float32)
    return Dataset(train, test, volume)


def check_one_scanner(dataset: Dataset, where) -> None:
    """Raises InputError unless the test views differ from the training views in their angles only."""
    if dataset.test is None:
        return
    a, b = dataset.train.geometry, dataset.test.geometry
    if from_geometry(a) != from_geometry(replace(b, angles=a.angles)):
        raise InputError(f'{where}: this format holds one scanner, but the training and test views have '
                         'different geometries; write them as two files')
