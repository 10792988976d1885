"""Volumes written slab by slab, which need not fit into memory: NIfTI, and OME-Zarr with a pyramid.

Both keep slices along z together, so that a slab is appended to a NIfTI file, and makes whole chunks of a Zarr array.
"""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.arrays import numeric
from lingo_mi.files.dicom import require_hounsfield, write_dicom
from lingo_mi.files.units import PER_MM, Unit
from lingo_mi.files.volumes import volume_header
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage.file_access import (
    flush,
    flush_folder,
    new_folder,
    optional,
    replacing,
    require_new_folder,
    take_place,
    writing,
)

NIFTI, ZARR, DICOM = ('.nii', '.nii.gz'), ('.ome.zarr', '.zarr'), '.dicom'
THICKNESS = 64  # slices of a slab, unless the caller chooses
AXES = 'z', 'y', 'x'
GROWING = 'growing.ome.zarr'  # a `shared_zarr` while workers fill it
HALVES = 'halves'  # its folder of slabs at half the resolution
CHUNK = 64  # voxels a side of an OME-Zarr's chunks, at most
LEAST = 64  # voxels along the longest side of the coarsest level of a pyramid


def plan_and_error_map(path: Path) -> tuple[Path, Path]:
    """The files that stand beside a volume of the algorithm `best`: its plan, and its map of errors in the volume's format, of
    DICOM in NIfTI."""
    ending = next((ending for ending in (*NIFTI, *ZARR) if path.name.endswith(ending)), path.suffix)
    name = path.name.removesuffix(ending)
    ending = '.nii.gz' if ending == DICOM else ending
    return path.with_name(f'{name}-plan.json'), path.with_name(f'{name}-error{ending}')


def check_volume_name(path: Path, unit: Unit = PER_MM) -> None:
    """Raises InputError unless a volume can be written under this name, in this unit, with the packages that are installed."""
    if not path.name.endswith((*NIFTI, *ZARR, DICOM)):
        raise InputError(
            f'{path}: volumes are written as NIfTI, OME-Zarr or DICOM; give a name that ends in .nii, .nii.gz, .ome.zarr or '
            f'{DICOM}'
        )
    if path.name.endswith(DICOM):
        optional('pydicom')
        require_hounsfield(path, unit)
    if path.name.endswith(ZARR):
        optional('zarr', 'ome-zarr')


def write_slabs(path: PathLike | str, grid: Grid, slabs: Iterable[np.ndarray], unit: Unit = PER_MM) -> None:
    """Write a volume, whole or not at all, holding one slab of it at a time.

    Parameters
    ----------
    path : path-like
        .nii, .nii.gz, or a new folder .ome.zarr (OME-NGFF 0.5: axes z, y, x in mm, and coarser levels by means of 2 x 2 x 2
        voxels) or .dicom (`dicom.write_dicom`).
    grid : Grid
        Grid of the whole volume.
    slabs : Iterable[ndarray]
        Densities per mm, float32 [x, y, slices], from the first slice on, together the whole volume.
    unit : Unit
        Unit of the values in the file.

    Raises
    ------
    InputError
        For another suffix, values that are not finite, slabs that do not make the volume, and a file that cannot be written.
        Slabs of `THICKNESS` slices make whole chunks of .ome.zarr, which are written fastest.

    Examples
    --------
    >>> write_slabs('foot.ome.zarr', scan.geometry.grid, FDK().slabs(scan, 64))
    """
    path = Path(path)
    check_volume_name(path, unit)
    write = _write_nifti if path.name.endswith(NIFTI) else _write_zarr if path.name.endswith(ZARR) else write_dicom
    write(path, grid, _checked(path, grid, slabs, unit), unit)


def _checked(path: Path, grid: Grid, slabs: Iterable[np.ndarray], unit: Unit):
    """The slabs in the unit, float32, with their first slices."""
    begin = 0
    for slab in slabs:
        slab = np.asarray(numeric(np.asarray(slab), path, 3), np.float32)
        if slab.shape[:2] != grid.shape[:2] or begin + slab.shape[2] > grid.shape[2]:
            raise InputError(f'{path}: slabs of the shape {slab.shape} do not make {grid.shape} voxels')
        yield begin, unit.values(slab)
        begin += slab.shape[2]
    if begin < grid.shape[2]:
        raise InputError(f'{path}: slabs of {begin} slices do not make {grid.shape} voxels')


def _write_nifti(path, grid, slabs, unit):
    header = volume_header(path, grid, unit.description)
    with ExitStack() as stack:
        temporary = stack.enter_context(replacing(path))
        if path.suffix == '.gz':
            file = stack.enter_context(gzip.open(temporary, 'wb', 1))  # nibabel's level
        else:
            file = stack.enter_context(open(temporary, 'wb'))
        file.write(header)
        for _, slab in slabs:
            file.write(slab.astype('<f4', copy=False).tobytes(order='F'))


def _write_zarr(path, grid, slabs, unit):
    with new_folder(path) as temporary:
        levels = _new_zarr(temporary, grid, unit.description)
        for begin, slab in _grouped(slabs, 2 ** (len(levels) - 1)):
            _add(levels, begin, slab.transpose(2, 1, 0))


def _new_zarr(folder: Path, grid: Grid, description: str) -> list[Any]:
    """The arrays of an OME-Zarr's levels, still empty, the finest first."""
    zarr, writer = optional('zarr', 'ome-zarr'), optional('ome_zarr.writer', 'ome-zarr')
    group = zarr.open_group(str(folder), mode='w', zarr_format=3)
    levels = [
        group.create_array(
            str(i), shape=s, chunks=tuple(min(n, CHUNK) for n in s), dtype='float32', dimension_names=AXES
        )
        for i, s in enumerate(_level_shapes(grid))
    ]
    _describe(writer, group, grid, len(levels))
    group.attrs['lingo_mi'] = description
    return levels


def _level_shapes(grid: Grid) -> list[tuple[int, ...]]:
    """The shapes [z, y, x] of an OME-Zarr's levels, the finest first."""
    shapes = [grid.shape[::-1]]
    while max(shapes[-1]) > LEAST and min(shapes[-1]) > 1:
        shapes.append(tuple(n // 2 for n in shapes[-1]))
    return shapes


def require_whole_chunks(path: Path, thickness: int, unit: Unit = PER_MM) -> None:
    """Raises InputError unless slabs are whole chunks of an OME-Zarr, which several processes may then write at once, per mm."""
    if unit != PER_MM:
        raise InputError('workers of a cluster write densities per mm: leave units out')
    if not path.name.endswith(ZARR):
        raise InputError(f'{path}: workers of a cluster write parts of one .ome.zarr; give such a name')
    if thickness % CHUNK:
        raise InputError(
            f'slabs must have a multiple of {CHUNK} slices on a cluster, not {thickness}: give slab={CHUNK}'
        )


@dataclass(frozen=True)
class SharedZarr:
    """An OME-Zarr that several processes fill with slabs, see `shared_zarr`. It can be sent to workers.

    Parameters
    ----------
    folder : Path
        Of the OME-Zarr while it grows.
    """

    folder: Path

    def holds(self, begin: int) -> bool:
        """Return whether the slab that begins at this slice has been written."""
        return self._half(begin).exists()

    def write(self, begin: int, slab: np.ndarray) -> None:
        """Write a slab [x, y, z] from the slice `begin` on, and its means for the next level.

        Raises
        ------
        InputError
            If the disk is full, or the file cannot be written for another reason.
        """
        end = begin + slab.shape[2]
        with writing(self.folder):
            array = optional('zarr', 'ome-zarr').open_group(str(self.folder), mode='r+')['0']
            array[begin:end] = slab.transpose(2, 1, 0)
            for k in range(begin // CHUNK, -(-end // CHUNK)):
                chunks = self.folder / '0' / 'c' / str(k)
                if chunks.exists():  # chunks of zeros have no file
                    flush(chunks)
            # The means come last, because they say that the slab is complete.
            with replacing(self._half(begin)) as temporary, open(temporary, 'wb') as file:
                np.save(file, _halved(slab.transpose(2, 1, 0)).transpose(2, 1, 0))

    def _half(self, begin):
        return self.folder / HALVES / f'{begin:08d}.npy'


@contextmanager
def shared_zarr(path: Path, grid: Grid, folder: Path, description: str = 'density per mm') -> Iterator[SharedZarr]:
    """An OME-Zarr that several processes fill with slabs, see `require_whole_chunks`.

    It grows in `folder`, and takes its place with its coarser levels when the block ends without an error. After an error it
    stays, and the next call with the same folder continues it.

    Parameters
    ----------
    path : Path
        Of the OME-Zarr, a new folder.
    grid : Grid
        Grid of the whole volume.
    folder : Path
        On the disk of `path`. The caller makes sure that it belongs to this volume.
    description : str
        What the values are.

    Raises
    ------
    InputError
        If `path` exists, or cannot be written.
    """
    require_new_folder(path)
    growing = folder / GROWING
    halves = growing / HALVES
    with writing(growing):
        if not halves.is_dir():  # it is made last
            shutil.rmtree(growing, ignore_errors=True)
            growing.mkdir()
            _new_zarr(growing, grid, description)
            halves.mkdir()
    yield SharedZarr(growing)
    with writing(growing):
        group = optional('zarr', 'ome-zarr').open_group(str(growing), mode='r+')
        levels = [group[str(i)] for i in range(len(_level_shapes(grid)))]
        half = (np.load(file) for file in sorted(halves.glob('[0-9]*.npy')))
        if len(levels) > 1:
            for begin, slab in _grouped(((0, slab) for slab in half), 2 ** (len(levels) - 2)):
                _add(levels[1:], begin, slab.transpose(2, 1, 0))
        flush(growing)
        shutil.rmtree(halves)
        take_place(growing, path)
        flush_folder(path.parent)


def _halved(slab: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 x 2 voxels [z, y, x]; a voxel left over is in none of them."""
    for axis in range(3):  # pair by pair, so that rounding does not depend on how the slab lies in memory
        pairs = np.moveaxis(slab, axis, 0)
        whole = len(pairs) // 2 * 2
        slab = np.moveaxis((pairs[0:whole:2] + pairs[1:whole:2]) / 2, 0, axis)
    return slab


def _grouped(slabs: Iterable[tuple[int, np.ndarray]], step: int) -> Iterator[tuple[int, np.ndarray]]:
    """The same slices in slabs that begin at multiples of a pyramid's coarsest step."""
    begin, pending = 0, None
    for _, slab in slabs:
        pending = slab if pending is None else np.concatenate([pending, slab], 2)
        whole = pending.shape[2] // step * step
        if whole:
            yield begin, pending[:, :, :whole]
            begin, pending = begin + whole, pending[:, :, whole:]
    if pending is not None and pending.shape[2]:
        yield begin, pending


def _add(levels: list[Any], begin: int, slab: np.ndarray) -> None:
    """Write a slab [z, y, x] to every level."""
    for i, level in enumerate(levels):
        if i:
            slab = _halved(slab)
            begin //= 2
        end = min(begin + len(slab), level.shape[0])
        level[begin:end] = slab[: end - begin]


def _describe(writer, group, grid, levels):
    corner, step = grid.first_voxel[::-1], np.array(grid.spacing)[::-1]
    datasets = [
        dict(
            path=str(i),
            coordinateTransformations=[
                dict(type='scale', scale=(step * 2**i).tolist()),
                dict(type='translation', translation=(corner + step * (2**i - 1) / 2).tolist()),
            ],
        )
        for i in range(levels)
    ]
    axes = [dict(name=name, type='space', unit='millimeter') for name in AXES]
    writer.write_multiscales_metadata(group, datasets, axes=axes)
