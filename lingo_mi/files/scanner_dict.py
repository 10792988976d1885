"""A scanner as a dictionary with TIGRE's names, nVoxel in (x, y, z), as in the pickle, the R2 folder and the YAML file."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry
from lingo_mi.geometry.grid import Grid, grid_of
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import helix
from lingo_mi.scan import Dataset, Scan, StoredViews

# Names that move the scanner off its circle.
MOTION = ('rotDetector', 'COR', 'tilt', 'pitch', 'z')


def _floats(value) -> np.ndarray:
    """Raises ValueError, TypeError or OverflowError for anything but numbers, also for true and false."""
    if isinstance(value, np.ndarray) and value.dtype.kind not in 'uif':
        raise ValueError
    array = np.asarray(value, float)  # comes first: it refuses values that are nested too deep to be searched
    if _has_truth(value):
        raise ValueError
    return array


def _has_truth(value) -> bool:
    return isinstance(value, bool) or isinstance(value, list | tuple) and any(map(_has_truth, value))


def _mode(values: dict, where: PathLike | str) -> str:
    mode = values.get('mode')
    if mode is not None and not isinstance(mode, str):
        raise InputError(f'{where}: mode must be cone or parallel, not {shown(mode)}')
    return mode or 'cone'


def _numbers(values: dict, name: str, where: PathLike | str, length: int) -> np.ndarray:
    try:
        array = _floats(values[name]).ravel()
    except (TypeError, ValueError, OverflowError):
        raise InputError(f'{where}: {name} must be numbers, not {shown(values[name])}') from None
    if array.size not in (1, length):
        raise InputError(f'{where}: {name} must be {length} numbers, not {shown(values[name])}')
    return np.broadcast_to(array, length)


def _counts(values: dict, name: str, where: PathLike | str, length: int) -> np.ndarray:
    if values.get(name) is None:
        raise InputError(f'{where}: {name} is missing; add it')
    array = _numbers(values, name, where, length)
    if not (np.isfinite(array).all() and np.array_equal(array, np.round(array))):
        raise InputError(f'{where}: {name} must be whole numbers, not {shown(values[name])}')
    return array


def _steps(values: dict, kind: str, counts: np.ndarray, where: PathLike | str) -> np.ndarray:
    """d = s / n: either may be given; both must agree."""
    from_side = None
    if values.get('s' + kind) is not None:
        from_side = _numbers(values, 's' + kind, where, len(counts)) / np.maximum(counts, 1)
    if values.get('d' + kind) is None:
        if from_side is None:
            raise InputError(f'{where}: neither d{kind} nor s{kind} is given; add one of them')
        return from_side
    d = _numbers(values, 'd' + kind, where, len(counts))
    if from_side is not None and not np.allclose(d, from_side, rtol=1e-3, atol=0):
        raise InputError(f'{where}: d{kind} and s{kind} disagree (s{kind} = n{kind} * d{kind}); remove one of them')
    return d


def _per_view(values, name, where, n, length, default=0.0):
    """A value given once or for every view: float64 [length] or [n, length] (a length of 1: one number or [n])."""
    if values.get(name) is None:
        return np.full(length, default) if length > 1 else np.float64(default)
    try:
        array = _floats(values[name])
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    shape = (n, length) if length > 1 else (n,)
    if array.shape == shape and np.isfinite(array).all():
        return array
    if array.size not in (1, length) or array.ndim > 1 or not np.isfinite(array).all():
        raise InputError(
            f'{where}: {name} must be {length} number{"s" * (length > 1)}, or that for each of {n} views, not '
            f'{shown(values[name])}'
        )
    return np.broadcast_to(array.ravel(), length) if length > 1 else np.float64(array.ravel()[0])


def _dimensions(value) -> int:
    try:
        return np.ndim(value)
    except ValueError:  # lists of several lengths, which are refused where they are read
        return 0


def moves(values: dict, n: int) -> bool:
    """Return whether a scanner of n views leaves the circle: it has a name of MOTION, or a number for every view."""
    lengths = dict(DSO=1, DSD=1, offDetector=2, offOrigin=3)
    several = any(
        _dimensions(values[k]) == (2 if length > 1 else 1) and (length > 1 or len(values[k]) > 1)
        for k, length in lengths.items()
        if values.get(k) is not None
    )
    return several or any(values.get(k) is not None for k in MOTION)


def _moving(values: dict, angles, where: PathLike | str, mode: str, sizes: dict[str, Any]) -> Geometry:
    """`to_geometry` for a scanner that leaves the circle, with the panel and the grid of `sizes`."""
    n = len(angles)

    def each(name, length=1):
        return _per_view(values, name, where, n, length)

    if values.get('pitch') is not None and values.get('z') is not None:
        raise InputError(f'{where}: pitch and z both say the height of the views; remove one of them')
    height = each('z')
    if values.get('pitch') is not None:
        if np.ndim(angles) == 2:
            raise InputError(f'{where}: pitch needs one angle a view, not three; give z instead')
        height = helix(angles, float(_numbers(values, 'pitch', where, 1)[0]))
    return Geometry.per_view(
        DSO=each('DSO'),
        DSD=each('DSD'),
        angles=angles,
        mode=mode,
        offOrigin=each('offOrigin', 3),
        offDetector=each('offDetector', 2),
        rotDetector=np.radians(each('rotDetector', 3)),
        COR=each('COR'),
        tilt=np.radians(each('tilt')),
        height=height,
        **sizes,
    )


def to_geometry(
    values: dict,
    angles: ArrayLike,
    where: PathLike | str,
    *,
    detector_shape: tuple[int, ...] | None = None,
    offset_order: str = 'vu',
) -> Geometry:
    """A Geometry from TIGRE's names.

    Parameters
    ----------
    values : dict
        DSO, DSD, nDetector, dDetector or sDetector in (v, u), nVoxel, dVoxel or sVoxel in (x, y, z); optional: mode, offOrigin
        (x, y, z), offDetector; all lengths in mm. With offset_order 'vu', DSO, DSD, offOrigin and offDetector may be lists of one
        value a view, and rotDetector, COR and tilt (one value or one a view; angles in degrees), pitch (mm a turn) or z (mm) may
        be given: see `Geometry.per_view` and `trajectories.helix`.
    angles : array_like
        [n] radians; [n, 3] for TIGRE's Euler angles.
    where : path-like
        The file, for messages.
    detector_shape : tuple[int, ...] or None
        (v, u) pixels of the projections; if nDetector has these the other way round, nDetector and the panel's size are taken as
        (u, v).
    offset_order : str
        'vu' (TIGRE) or 'uv' (NAF and R2-Gaussian, which hand it to TIGRE reversed).

    Raises
    ------
    InputError
        If a value is missing, contradictory or out of range.
    """
    values, angles = dict(values), np.asarray(angles)
    n_detector = _counts(values, 'nDetector', where, 2)
    d_detector = _steps(values, 'Detector', n_detector, where)
    if detector_shape is not None and tuple(n_detector) != tuple(detector_shape):
        if tuple(n_detector[::-1]) != tuple(detector_shape):
            raise InputError(
                f'{where}: nDetector = {[int(n) for n in n_detector]} does not match the '
                f'projections, which have {detector_shape[0]} rows and {detector_shape[1]} '
                'columns; correct nDetector'
            )
        n_detector, d_detector = n_detector[::-1], d_detector[::-1]
    n_voxel = _counts(values, 'nVoxel', where, 3)
    mode = _mode(values, where)
    for name in ('DSO', 'DSD'):
        if values.get(name) is None:
            if mode != 'parallel':
                raise InputError(f'{where}: {name} is missing; add the distance from the source, in mm')
            values[name] = 0.0  # puts the panel on the axis, which does not matter for a parallel beam
    d_voxel = _steps(values, 'Voxel', n_voxel, where)
    voxels: dict[str, Any] = dict(nVoxel=n_voxel, dVoxel=d_voxel)
    sizes: dict[str, Any] = dict(nDetector=n_detector, dDetector=d_detector)
    try:
        if offset_order == 'vu' and (np.ndim(angles) == 2 or moves(values, len(angles))):
            return _moving(values, angles, where, mode, sizes | voxels)
    except InputError as error:
        raise error if str(error).startswith(str(where)) else InputError(f'{where}: {error}') from None
    origin, offset = (
        np.zeros(length) if values.get(name) is None else _numbers(values, name, where, length)
        for name, length in (('offOrigin', 3), ('offDetector', 2))
    )
    sizes['offDetector'] = offset[::-1] if offset_order == 'uv' else offset
    try:
        return CircularGeometry(
            DSO=float(_numbers(values, 'DSO', where, 1)[0]),
            DSD=float(_numbers(values, 'DSD', where, 1)[0]),
            grid=grid_of(voxels | dict(offOrigin=origin)),
            angles=angles,
            mode=mode,
            **sizes,
        )
    except InputError as error:
        raise error if str(error).startswith(str(where)) else InputError(f'{where}: {error}') from None


def to_posed(values: dict, views: Callable[..., Rays], where: PathLike | str) -> Geometry:
    """A Geometry of given poses: views(nDetector, dDetector or None, parallel, offOrigin) gives them.

    Parameters
    ----------
    values : dict
        nDetector, nVoxel, dVoxel or sVoxel; optional: dDetector or sDetector, mode, offOrigin.

    Raises
    ------
    InputError
        If a value is missing or out of range, or if one is given that the poses already contain.
    """
    contradictions = [
        k
        for k in ('DSO', 'DSD', 'offDetector', 'angles', 'totalAngle', 'startAngle', *MOTION)
        if values.get(k) is not None
    ]
    if contradictions:
        raise InputError(
            f'{where}: {contradictions[0]} and poses both say where source and panel are; remove one of them'
        )
    n_detector, n_voxel = _counts(values, 'nDetector', where, 2), _counts(values, 'nVoxel', where, 3)
    step = None
    if values.get('dDetector') is not None or values.get('sDetector') is not None:
        step = _steps(values, 'Detector', n_detector, where)
    origin = np.zeros(3) if values.get('offOrigin') is None else _numbers(values, 'offOrigin', where, 3)
    mode = _mode(values, where)
    d_voxel = _steps(values, 'Voxel', n_voxel, where)
    try:
        if mode not in ('cone', 'parallel'):
            raise InputError(f"mode must be 'cone' or 'parallel', not {shown(mode)}")
        return Geometry.from_poses(
            views(n_detector, step, mode == 'parallel', origin),
            n_detector,
            nVoxel=n_voxel,
            dVoxel=d_voxel,
            offOrigin=origin,
        )
    except InputError as error:
        raise error if str(error).startswith(str(where)) else InputError(f'{where}: {error}') from None


def from_geometry(geometry: CircularGeometry, offset_order: str = 'vu') -> dict:
    """The inverse of `to_geometry` for a circular scan, without the angles: plain floats, ints and lists, mm."""
    offset = geometry.offDetector[::-1] if offset_order == 'uv' else geometry.offDetector
    return {
        'mode': geometry.mode,
        'DSD': geometry.DSD,
        'DSO': geometry.DSO,
        'nDetector': list(geometry.nDetector),
        'dDetector': list(geometry.dDetector),
        **of_grid(geometry.grid),
        'offDetector': list(offset),
    }


def of_grid(grid: Grid) -> dict[str, list]:
    """A voxel grid by TIGRE's names, (x, y, z)."""
    return {'nVoxel': list(grid.shape), 'dVoxel': list(grid.spacing), 'offOrigin': list(grid.centre)}


def angle_range(angles: np.ndarray) -> tuple[float, float]:
    """(startAngle, totalAngle) in degrees, as if `angles` (radians) were evenly spaced; formats that list the
    angles carry these two for information only."""
    low, high, n = np.degrees(angles.min()), np.degrees(angles.max()), len(angles)
    return float(low), float((high - low) * n / (n - 1)) if n > 1 else 360.0


def make_scan(
    geometry: Geometry, projections: np.ndarray | StoredViews, where: PathLike | str, valid: np.ndarray | None = None
) -> Scan:
    """A Scan whose InputError names the file."""
    try:
        return Scan(geometry, projections, valid)  # type: ignore[arg-type] - stored views are read when needed
    except InputError as error:
        raise InputError(f'{where}: {error}') from None


def make_dataset(train: Scan, test: Scan | None, volume: np.ndarray | None, where: PathLike | str) -> Dataset:
    """A Dataset with a float32 volume, after a check that the volume [x, y, z] has nVoxel voxels."""
    if volume is not None:
        if volume.shape != train.geometry.grid.shape:
            raise InputError(
                f'{where}: the volume has the shape {volume.shape}, but nVoxel is '
                f'{train.geometry.grid.shape}; volumes are stored [x, y, z]'
            )
        volume = np.asarray(volume, np.float32)
    return Dataset(train, test, volume)


def circular_geometry(dataset: Dataset, where: PathLike | str) -> CircularGeometry:
    """The geometry of the training views, for formats of circular scans.

    Raises
    ------
    InputError
        If a view is not on the circle, or the test views differ in more than their angles.
    """
    geometry = dataset.train.geometry
    circular = all(
        isinstance(scan.geometry, CircularGeometry) for scan in (dataset.train, dataset.test) if scan is not None
    )
    if not isinstance(geometry, CircularGeometry) or not circular:
        raise InputError(
            f"{where}: this format holds circular scans only, and this one has other poses; write it as 'npy' or 'exr'"
        )
    require_same_scanner(dataset, where)
    return geometry


def require_same_scanner(dataset: Dataset, where: PathLike | str) -> None:
    """Raises InputError unless the test views differ from the training views in their angles or poses only."""
    geometries = [scan.geometry for scan in (dataset.train, dataset.test) if scan is not None]
    circles = [g for g in geometries if isinstance(g, CircularGeometry)]
    if len(circles) == len(geometries):
        scanners = [from_geometry(g) for g in circles]
    else:
        scanners = [
            (g.mode, g.nDetector, g.grid, g.radius if isinstance(g, CurvedGeometry) else None) for g in geometries
        ]
    if scanners[0] != scanners[-1]:
        raise InputError(
            f'{where}: this format holds one scanner, but the training and test views have '
            'different geometries; write them as two files'
        )
