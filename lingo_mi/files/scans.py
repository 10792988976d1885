"""Scans in all formats: `read_scan` and `write_scan` choose the reader and the writer.

Besides the NAF pickle (`naf`) and the R2-Gaussian folder (`r2`):

Projections with a geometry file: `scan.npy` [n, v, u] and `scan.yml`, TIGRE's names, lengths in mm, angles in
degrees:

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
    history                how the projections were made, for people: `lingo-mi import` writes it
    input                  line_integral (default) or intensity, which needs I0, the unattenuated intensity

DSO, DSD, offDetector, offOrigin (TIGRE's: it moves the object), rotDetector, COR and tilt may be lists of one
value for every view; an angle may be three, TIGRE's Euler angles.

Any other name is refused, so that a misspelt or unsupported one is noticed. TIGRE's accuracy and filter do not
describe the scanner and are ignored.

Projections in chunks: `scan.zarr`, a Zarr array [n, v, u], and `scan.yml` as above. What works on slabs reads the views
that it needs; all else reads them all.

A folder of EXR images: `geometry.yml` as above (with `test_angles` or `test_poses` if there are held-out views),
`train/0000.exr` …, `test/0000.exr` …, each one view, and `volume.nii.gz` if the true volume is known.

Public measured scans as .npz: see `lingo_mi.files.public_scans`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import require_room
from lingo_mi.common.parsing import nearest
from lingo_mi.files import arrays, naf, plain_yaml, public_scans, r2
from lingo_mi.files.images import read_exr, write_exr
from lingo_mi.files.poses import read_poses
from lingo_mi.files.scanner_dict import (
    MOTION,
    from_geometry,
    make_dataset,
    make_scan,
    of_grid,
    require_same_scanner,
    to_geometry,
    to_posed,
)
from lingo_mi.files.slices import by_number
from lingo_mi.files.volumes import read_volume, write_volume
from lingo_mi.files.zarr_views import write_zarr_views, zarr_views
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry, astra
from lingo_mi.geometry.trajectories import circular
from lingo_mi.scan import Dataset, Scan
from lingo_mi.storage.file_access import beside, new_folder, reading, replacing

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
    'history',
    *MOTION,
}


MOST_LISTED = 1000  # poses in a geometry file
FRAMES = {  # raw ones
    *('.tif', '.tiff', '.edf', '.png', '.jp2', '.j2k', '.jpx', '.his', '.hnd', '.hnc', '.xim'),
    *('.h5', '.hdf5', '.hdf', '.nxs', '.nx', '.dcm', '.ima', '.txrm', '.xrm'),
}
ARRAYS = '.npy', '.zarr'  # projections with a geometry file
VALID, POSES = '.valid.npy', '.poses.npy'  # endings of the files beside an .npy


# ---- geometry files ----------------------------------------------------------------------------------------


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


def _valid(values, shape, where):
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


def _line_integrals(projections, values, where, projections_path):
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


def _dump_yaml(path, geometry, test=None, *, poses=None, **more):
    """Writes a geometry file. poses: the name of a file that holds them; None: they are lines of this one."""
    bend = {'radius': geometry.radius} if isinstance(geometry, CurvedGeometry) else {}
    flat = _flat(geometry)
    if isinstance(flat, CircularGeometry) and _on_circle(geometry) and (test is None or _on_circle(test)):
        values = {**from_geometry(flat), 'angles': np.degrees(geometry.angles).tolist()}
        if test is not None:
            values['test_angles'] = np.degrees(test.angles).tolist()
    else:
        values = {'mode': geometry.mode, 'nDetector': list(geometry.nDetector), **of_grid(geometry.grid)}
        values['poses'] = poses or astra.to_vectors(flat.rays(), geometry.nDetector).tolist()
        if test is not None:
            values['test_poses'] = astra.to_vectors(_flat(test).rays(), test.nDetector).tolist()
    values |= bend | more
    path.write_text(yaml.safe_dump(values, sort_keys=False, default_flow_style=None), encoding='utf-8')


def _flat(geometry):
    """The scan with the flat panel that a curved one touches along its middle; one with a flat panel as it is."""
    return geometry.flat if isinstance(geometry, CurvedGeometry) else geometry


def _on_circle(geometry):
    """Whether the numbers of a circle describe a scan: a curved panel off the central ray is turned, too."""
    flat = _flat(geometry)
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
    beside = [path.with_suffix(suffix) for suffix in ('.yml', '.yaml')]
    file = next((p for p in beside if p.exists()), None)
    if file is None:
        raise InputError(f'{path}: needs its scan geometry; put it in {beside[0].name} beside it or name the file')
    return file


def rows_run_up(values: dict, name: str = 'poses') -> bool:
    """Whether the rows of the projections that go with a geometry file's values run up: RTK's do, this package's run down."""
    return str(values.get(name)).lower().endswith('.xml')


def _values_of_one_scan(geometry):
    """The names of a geometry file that goes with one array."""
    values = load_yaml(geometry)
    for name in ('test_angles', 'test_poses'):
        if values.get(name) is not None:
            raise InputError(
                f'{geometry}: {name} goes with a folder of EXR views; an array holds the views to fit alone'
            )
    return values


def _read_zarr(path, geometry):
    values = _values_of_one_scan(geometry)
    if values.get('input', 'line_integral') != 'line_integral':
        raise InputError(
            f'{geometry}: projections in a .zarr are line integrals: leave out input, and take the logarithm'
        )
    views = zarr_views(path, rows_run_up(values))
    valid = _valid(values, views.shape, geometry)
    if valid is not None:
        valid = valid[:, ::-1] if views.rows_run_up else valid
    return Dataset(make_scan(posed_geometry(values, len(views.numbers), geometry), views, path, valid))


def _read_npy(path, geometry):
    values = _values_of_one_scan(geometry)
    projections = arrays.read_npy(path, 3, finite=values.get('valid') is None)
    valid = _valid(values, projections.shape, geometry)
    if valid is not None:
        projections = np.where(valid, projections, 1)  # a value with a logarithm
    g = posed_geometry(values, len(projections), geometry)
    if rows_run_up(values):
        projections, valid = projections[:, ::-1], None if valid is None else valid[:, ::-1]
    return Dataset(make_scan(g, _line_integrals(projections, values, geometry, path), path, valid))


def written_files(path: Path) -> list[Path]:
    """All files that a scan `path`, an .npy, may be written to."""
    return [path, path.with_suffix('.yml'), *(path.with_name(path.stem + ending) for ending in (VALID, POSES))]


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


def _write_zarr(path, dataset):
    path, scan = Path(path), dataset.train
    if path.suffix != '.zarr':
        raise InputError(f'{path}: give projections in chunks a name that ends in .zarr')
    if dataset.test is not None or dataset.volume is not None:
        raise InputError(f'{path}: a .zarr holds the training views alone; drop the test views and the volume')
    with replacing(path.with_suffix('.yml')) as file:
        _dump_yaml(file, scan.geometry)
        write_zarr_views(path, scan.projections)


def _write_npy(path, dataset, history=None):
    path = Path(path)
    if path.suffix != '.npy':
        raise InputError(
            f'{path}: projections are written as .npy with a .yml beside it; give a name that ends in .npy'
        )
    if dataset.test is not None or dataset.volume is not None:
        raise InputError(
            f"{path}: an .npy file holds the training views alone; write 'naf', 'r2' or 'exr' "
            'instead, or drop the test views and the volume'
        )
    more: dict = {'input': 'line_integral'}
    if history is not None:
        more['history'] = history
    content = {path: dataset.train.projections}
    if dataset.train.valid is not None:
        more['valid'] = path.stem + VALID
        content[path.with_name(more['valid'])] = dataset.train.valid
    geometry = dataset.train.geometry
    if len(geometry) > MOST_LISTED and not _on_circle(geometry):
        more['poses'] = path.stem + POSES
        content[path.with_name(more['poses'])] = astra.to_vectors(_flat(geometry).rays(), geometry.nDetector)
    # An earlier scan stays whole until all of the new one is on the disk.
    with ExitStack() as files:
        for file, values in content.items():
            arrays.write_npy_in_place(files.enter_context(replacing(file)), values)
        _dump_yaml(files.enter_context(replacing(path.with_suffix('.yml'))), geometry, **more)


# ---- EXR folders -------------------------------------------------------------------------------------------


def _read_stack(folder):
    files = sorted(folder.glob('*.exr'), key=by_number)
    if not files:
        raise InputError(f'{folder}: holds no .exr views; give at least one')
    images = []
    for file in files:
        image = read_exr(file)
        if not images:
            require_room(8 * len(files) * image.size, folder)
        images.append(image)
        if image.shape != images[0].shape:
            raise InputError(
                f'{file}: has the shape {image.shape}, but the first view has '
                f'{images[0].shape}; all views need one panel'
            )
    return np.stack(images)


def _read_exr_folder(folder):
    where = folder / 'geometry.yml'
    values = load_yaml(where)
    if values.get('valid') is not None:
        raise InputError(f'{where}: valid goes with .npy projections only')
    scans = {}
    for split in ('train', 'test'):
        has_test_views = values.get('test_angles') is not None or values.get('test_poses') is not None
        if split == 'test' and not (folder / split).is_dir() and not has_test_views:
            continue
        if split == 'test' and not has_test_views:
            raise InputError(
                f'{where}: test_angles is missing, but there is a folder of test views; add it, in degrees'
            )
        projections = _read_stack(folder / split)
        geometry = posed_geometry(values, len(projections), where, split == 'test')
        if rows_run_up(values, 'poses' if split == 'train' else 'test_poses'):
            projections = projections[:, ::-1]
        scans[split] = make_scan(geometry, _line_integrals(projections, values, where, folder / split), where)
    volume = folder / 'volume.nii.gz'
    return make_dataset(
        scans['train'], scans.get('test'), read_volume(volume).data if volume.exists() else None, volume
    )


def _write_exr_folder(path, dataset):
    require_same_scanner(dataset, path)
    with new_folder(path) as folder:
        for split, scan in (('train', dataset.train), ('test', dataset.test)):
            if scan is not None:
                (folder / split).mkdir()
                for i, image in enumerate(scan.projections):
                    write_exr(folder / split / f'{i:04d}.exr', image)
        geometry = dataset.train.geometry
        if dataset.volume is not None:
            write_volume(folder / 'volume.nii.gz', dataset.volume, geometry.grid)
        _dump_yaml(folder / 'geometry.yml', geometry, dataset.test and dataset.test.geometry, input='line_integral')


# ---- any format --------------------------------------------------------------------------------------------


def read_scan(path: PathLike | str, geometry: PathLike | str | None = None, name: str = 'ta') -> Dataset:
    """Reads a scan; the format follows from the path.

    Parameters
    ----------
    path : path-like
        .pickle, .pkl: NAF / SAX-NeRF (X3D); .npy, or a folder .zarr: projections with a geometry file; .npz: a public scan
        (`public_scans`); a folder with meta_data.json (R2-Gaussian) or with geometry.yml (EXR views).
    geometry : path-like or None
        The geometry file of an .npy or .zarr; without it, the .yml or .yaml of the same stem.
    name : str
        Which sinogram of the Helsinki Tomography Challenge.

    Returns
    -------
    Dataset
        A Dataset in mm: projections [view, v, u] are line integrals; test views and volume [x, y, z] are None if the format
        has none.

    Raises
    ------
    InputError
        If a file is missing, damaged, unknown, or contradicts its geometry.
    """
    return reader_of(path, geometry, name)()


def reader_of(path: PathLike | str, geometry: PathLike | str | None = None, name: str = 'ta') -> Callable[[], Dataset]:
    """What reads a scan when it is called.

    Raises
    ------
    InputError
        For what can be seen without that; arguments as for `read_scan`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if geometry is not None and suffix not in ARRAYS:
        raise InputError(
            f'{path}: carries its own geometry; a geometry file goes with projections in .npy or .zarr only'
        )
    if suffix == '.zarr' and path.is_dir():
        return partial(_read_zarr, path, geometry_file_of(path, geometry))
    if path.is_dir():
        if (path / r2.META).exists():
            return partial(r2.read_r2, path)
        if (path / 'geometry.yml').exists():
            return partial(_read_exr_folder, path)
        with reading(path, folder=True):
            if any(file.suffix.lower() in FRAMES for file in path.iterdir()):
                raise _raw_frames(path)
        raise InputError(
            f'{path}: has neither {r2.META} (R2-Gaussian) nor geometry.yml (EXR views); give a folder of a scan'
        )
    with reading(path):
        open(path, 'rb').close()
    if suffix in ('.pickle', '.pkl'):
        return partial(naf.read_naf, path)
    if suffix == '.npy':
        return partial(_read_npy, path, geometry_file_of(path, geometry))
    if suffix == '.npz':
        return partial(public_scans.read_public_scan, path, name)
    if suffix in FRAMES:
        raise _raw_frames(path)
    raise InputError(f'{path}: is not a known scan format; give .pickle, .npy, .npz, or a folder of a scan')


def _raw_frames(path):
    return InputError(
        f'{path}: holds raw frames; make a scan of them: lingo-mi import {path} --geometry scanner.yml --out scan.npy'
    )


_WRITERS = {'naf': naf.write_naf, 'r2': r2.write_r2, 'exr': _write_exr_folder, 'npy': _write_npy, 'zarr': _write_zarr}


def history_of(path: PathLike | str) -> Any:
    """What a scan's geometry file says of how it was made; None if it says nothing.

    Raises
    ------
    InputError
        As `read_scan` does.
    """
    path = Path(path)
    return load_yaml(geometry_file_of(path, None)).get('history') if path.suffix.lower() in ARRAYS else None


def write_scan(path: PathLike | str, dataset: Dataset | Scan, kind: str, history: dict | None = None) -> None:
    """Writes a scan that `read_scan` reads back, whole or not at all.

    Parameters
    ----------
    kind : str
        'naf': a pickle; 'r2': a new R2-Gaussian folder; 'exr': a new folder of EXR views; 'npy': `path` and its .yml, for
        training views alone, and the mask of valid pixels if there is one; 'zarr': a new folder in chunks, and its .yml, for
        training views alone.
    history : dict or None
        How it was made, plain values by name; for 'npy'.

    Raises
    ------
    InputError
        If the kind is unknown, a folder exists already, the file cannot be written, or the format cannot hold the data.
    """
    if kind not in _WRITERS:
        raise InputError(f'{kind!r} is not a kind of scan file; choose one of {", ".join(_WRITERS)}')
    dataset = Dataset(dataset) if isinstance(dataset, Scan) else dataset
    masked = any(scan is not None and scan.valid is not None for scan in (dataset.train, dataset.test))
    if masked and kind != 'npy':
        raise InputError(f"{path}: this format holds no mask of valid pixels; write 'npy'")
    if history is not None:
        if kind != 'npy':
            raise InputError(f"{path}: this format holds no history; write 'npy'")
        _write_npy(path, dataset, history)
        return
    _WRITERS[kind](path, dataset)
