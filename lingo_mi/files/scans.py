"""Scans in all formats: `read_scan` and `write_scan` choose the reader and the writer.

Besides the NAF pickle (`naf`) and the R2-Gaussian folder (`r2`):

Projections with a geometry file (`geometry_file`): `scan.npy` [n, v, u] and `scan.yml`.

Projections in chunks: `scan.zarr`, a Zarr array [n, v, u], or a dataset [n, v, u] of `scan.h5`, and `scan.yml` as above. Work on
slabs reads the views that it needs, and all other work reads all views.

A folder of EXR images: `geometry.yml` as above (with `test_angles` or `test_poses` if there are held-out views),
`train/0000.exr` …, `test/0000.exr` …, each one view, and `volume.nii.gz` if the true volume is known.

Public measured scans as .npz: see `lingo_mi.files.public_scans`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import require_room
from lingo_mi.files import arrays, naf, public_scans, r2
from lingo_mi.files.geometry_file import (
    array_values,
    dump_geometry,
    flat_panel,
    geometry_file_of,
    has_geometry_file,
    line_integrals,
    load_yaml,
    on_circle,
    posed_geometry,
    rows_run_up,
    valid_mask,
)
from lingo_mi.files.hdf5_views import SUFFIXES, hdf5_views
from lingo_mi.files.images import read_exr, write_exr
from lingo_mi.files.scanner_dict import make_dataset, make_scan, require_same_scanner
from lingo_mi.files.slices import by_number
from lingo_mi.files.volumes import read_volume, write_volume
from lingo_mi.files.zarr_views import VIEWS, new_zarr_views, zarr_views
from lingo_mi.geometry import Geometry, astra
from lingo_mi.scan import Dataset, Scan
from lingo_mi.storage.file_access import new_folder, reading, replacing, take_place

MOST_LISTED = 1000  # most poses that a geometry file lists
FRAMES = {  # raw ones
    *('.tif', '.tiff', '.edf', '.png', '.jp2', '.j2k', '.jpx', '.his', '.hnd', '.hnc', '.xim'),
    *(*SUFFIXES, '.dcm', '.ima', '.txrm', '.xrm'),
}
ARRAYS = '.npy', '.zarr', *SUFFIXES  # projections with a geometry file
VALID, POSES = '.valid.npy', '.poses.npy'  # endings of the files beside an .npy


# ---- arrays ------------------------------------------------------------------------------------------------


def _read_stored(path, geometry):
    """Projections that are read where they are needed, in a .zarr or an HDF5 file."""
    values = array_values(geometry)
    if values.get('input', 'line_integral') != 'line_integral':
        raise InputError(
            f'{geometry}: projections in a {path.suffix} are line integrals: leave out input, and take the logarithm'
        )
    dataset, flipped = values.get('dataset'), rows_run_up(values)
    if path.suffix.lower() == '.zarr':
        views = zarr_views(path, flipped)
    elif dataset is None or isinstance(dataset, str):
        views = hdf5_views(path, dataset, flipped)
    else:
        raise InputError(f'{geometry}: dataset must be the name of a dataset, not {shown(dataset)}')
    valid = valid_mask(values, views.shape, geometry)
    if valid is not None:
        valid = valid[:, ::-1] if flipped else valid
    return Dataset(make_scan(posed_geometry(values, len(views.numbers), geometry), views, path, valid))


def _read_npy(path, geometry):
    values = array_values(geometry)
    projections = arrays.read_npy(path, 3, finite=values.get('valid') is None)
    valid = valid_mask(values, projections.shape, geometry)
    if valid is not None:
        projections = np.where(valid, projections, 1)  # a value with a logarithm
    g = posed_geometry(values, len(projections), geometry)
    if rows_run_up(values):
        projections, valid = projections[:, ::-1], None if valid is None else valid[:, ::-1]
    return Dataset(make_scan(g, line_integrals(projections, values, geometry, path), path, valid))


def written_files(path: Path) -> list[Path]:
    """All files that a scan `path`, an .npy or .zarr, may be written to."""
    return [path, path.with_suffix('.yml'), *(path.with_name(path.stem + ending) for ending in (VALID, POSES))]


@dataclass
class ChunkedScan:
    """A scan in a .zarr while it is written, see `new_zarr_scan`.

    Attributes
    ----------
    projections : zarr.Array
        Line integrals float32 [n, v, u], fastest to write by `VIEWS` views.
    valid : ndarray
        Bool [n, v, u], in a file; at first, no pixel is valid.
    history : dict or None
        How the scan was made.
    """

    projections: Any
    valid: np.ndarray
    history: dict | None = None


@contextmanager
def new_zarr_scan(path: Path, geometry: Geometry) -> Iterator[ChunkedScan]:
    """A scan in chunks, with its geometry, mask and poses beside it, to be filled a few views at a time.

    All files take their places when the block ends without an error.

    Parameters
    ----------
    path : Path
        A new folder, .zarr.
    geometry : Geometry
        Of all views.

    Raises
    ------
    InputError
        If `path` exists, has another ending, or cannot be written.

    Examples
    --------
    >>> with new_zarr_scan(Path('scan.zarr'), geometry) as scan:
    ...     scan.projections[:4], scan.valid[:4] = first_views, True
    """
    if path.suffix != '.zarr':
        raise InputError(f'{path}: give projections in chunks a name that ends in .zarr')
    shape, more = (len(geometry), *geometry.nDetector), {}
    with ExitStack() as files:
        folder = files.enter_context(new_folder(path))
        array = new_zarr_views(folder, shape)
        mask = np.lib.format.open_memmap(folder / VALID, 'w+', bool, shape)  # until it is known if it is needed
        scan = ChunkedScan(array, mask)
        yield scan
        all_valid = all(view.all() for view in mask)
        mask.flush()
        scan.valid, mask = np.zeros(shape[:0], bool), None  # closes the file, for Windows
        if all_valid:
            (folder / VALID).unlink()
        else:
            more['valid'] = path.stem + VALID
            take_place(folder / VALID, files.enter_context(replacing(path.with_name(more['valid']))))
        _put_geometry(files, path, geometry, scan.history, more)


def _put_geometry(files, path, geometry, history, more):
    """The geometry file of an array, and the file of its poses, as part of a stack of files."""
    if history is not None:
        more['history'] = history
    if len(geometry) > MOST_LISTED and not on_circle(geometry):
        more['poses'] = path.stem + POSES
        poses = astra.to_vectors(flat_panel(geometry).rays(), geometry.nDetector)
        arrays.write_npy_in_place(files.enter_context(replacing(path.with_name(more['poses']))), poses)
    file = files.enter_context(replacing(path.with_suffix('.yml')))
    dump_geometry(file, geometry, input='line_integral', **more)


def _require_training_views(path, dataset):
    if dataset.test is not None or dataset.volume is not None:
        raise InputError(
            f"{path}: a {path.suffix} holds the training views alone; write 'naf', 'r2' or 'exr' instead, or drop the test "
            'views and the volume'
        )


def _write_zarr(path, dataset, history=None):
    path, scan = Path(path), dataset.train
    _require_training_views(path, dataset)
    with new_zarr_scan(path, scan.geometry) as new:
        new.history = history
        for first in range(0, len(scan), VIEWS):
            some = slice(first, first + VIEWS)
            new.projections[some] = scan.views(some)
            new.valid[some] = True if scan.valid is None else scan.valid[some]


def _write_npy(path, dataset, history=None):
    path, scan = Path(path), dataset.train
    if path.suffix != '.npy':
        raise InputError(
            f'{path}: projections are written as .npy with a .yml beside it; give a name that ends in .npy'
        )
    _require_training_views(path, dataset)
    more = {}
    # An earlier scan stays whole until all of the new one is on the disk.
    with ExitStack() as files:
        arrays.write_npy_in_place(files.enter_context(replacing(path)), scan.projections)
        if scan.valid is not None:
            more['valid'] = path.stem + VALID
            arrays.write_npy_in_place(files.enter_context(replacing(path.with_name(more['valid']))), scan.valid)
        _put_geometry(files, path, scan.geometry, history, more)


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
        scans[split] = make_scan(geometry, line_integrals(projections, values, where, folder / split), where)
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
        dump_geometry(folder / 'geometry.yml', geometry, dataset.test and dataset.test.geometry, input='line_integral')


# ---- any format --------------------------------------------------------------------------------------------


def read_scan(path: PathLike | str, geometry: PathLike | str | None = None, name: str = 'ta') -> Dataset:
    """Reads a scan; the format follows from the path.

    Parameters
    ----------
    path : path-like
        .pickle, .pkl: NAF / SAX-NeRF (X3D); .npy, .h5 (`hdf5_views`) or a folder .zarr: projections with a geometry file; .npz: a
        public scan (`public_scans`); a folder with meta_data.json (R2-Gaussian) or with geometry.yml (EXR views).
    geometry : path-like or None
        The geometry file of an .npy, .zarr or .h5; without it, the .yml or .yaml of the same stem.
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
    """Return a function that reads the scan when it is called.

    Raises
    ------
    InputError
        For what can be seen without that; arguments as for `read_scan`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if geometry is not None and suffix not in ARRAYS:
        raise InputError(
            f'{path}: carries its own geometry; a geometry file goes with projections in .npy, .zarr or .h5 only'
        )
    if suffix == '.zarr' and path.is_dir():
        return partial(_read_stored, path, geometry_file_of(path, geometry))
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
    if suffix in SUFFIXES and (geometry is not None or has_geometry_file(path)):
        return partial(_read_stored, path, geometry_file_of(path, geometry))
    if suffix in FRAMES:
        raise _raw_frames(path)
    raise InputError(f'{path}: is not a known scan format; give .pickle, .npy, .npz, or a folder of a scan')


def _raw_frames(path):
    return InputError(
        f'{path}: holds raw frames; make a scan of them: lingo-mi import {path} --geometry scanner.yml --out scan.npy'
    )


ARRAY_KINDS = 'npy', 'zarr'  # whose geometry file holds a mask and a history
_WRITERS = {'naf': naf.write_naf, 'r2': r2.write_r2, 'exr': _write_exr_folder, 'npy': _write_npy, 'zarr': _write_zarr}


def history_of(path: PathLike | str) -> Any:
    """Return the history in a scan's geometry file, which says how the scan was made; None if the file has no history.

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
        training views alone, and the mask of valid pixels if there is one; 'zarr': the same with a new folder in chunks.
    history : dict or None
        How it was made, plain values by name; for 'npy' and 'zarr'.

    Raises
    ------
    InputError
        If the kind is unknown, a folder exists already, the file cannot be written, or the format cannot hold the data.
    """
    if kind not in _WRITERS:
        raise InputError(f'{kind!r} is not a kind of scan file; choose one of {", ".join(_WRITERS)}')
    dataset = Dataset(dataset) if isinstance(dataset, Scan) else dataset
    masked = any(scan is not None and scan.valid is not None for scan in (dataset.train, dataset.test))
    if kind in ARRAY_KINDS:
        _WRITERS[kind](path, dataset, history)
        return
    if masked or history is not None:
        what = 'mask of valid pixels' if masked else 'history'
        raise InputError(f"{path}: this format holds no {what}; write 'npy' or 'zarr'")
    _WRITERS[kind](path, dataset)
