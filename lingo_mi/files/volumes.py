"""CT volumes: NIfTI, NRRD/MetaImage, OME-Zarr, NumPy, raw bytes, TIFF stacks and DICOM folders in; NIfTI out.

A volume is indexed [x, y, z] in the order of the file. Nothing is flipped; the affine gives the voxels' positions
in the world.

Values become density by these rules, the first that applies:

1. A file that `write_volume` or `slabs.write_slabs` wrote is returned unchanged, one in other units as density per mm.
2. Hounsfield units. They are recognised by a minimum of -500 or less, by DICOM or by `hu=True`; with `mu_water`
   also if rule 3 would refuse negative values. With `mu_water` (1/mm) they become mu_water (1 + HU / 1000), at
   least 0, in 1/mm. Without, they are clipped to [-1000, 2000] and mapped to [0, 1] (R2-Gaussian's rule).
3. Anything else is a density. Float values up to 1 stay; others are divided by their maximum. Negative
   fractions down to -10 % of the maximum are the noise of a reconstruction and become 0. Other negative
   values are refused as ambiguous; with `hu=False` they become 0 too.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common import notebook
from lingo_mi.common.arrays import short_repr
from lingo_mi.common.errors import InputError, shown
from lingo_mi.files import arrays, ome_zarr, slices
from lingo_mi.files.arrays import numeric
from lingo_mi.files.itk import read_metaimage, read_nrrd
from lingo_mi.files.nifti import read_nifti
from lingo_mi.files.units import PER_MM, Unit
from lingo_mi.files.voxels import LPS_TO_RAS, read_voxels
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage.file_access import reading, replacing

_OURS = 'lingo_mi: '
# Raw files known by their content: SHA-1 of the git blob -> shape [x, y, z], type. The first is the
# rotational C-arm scan `foot` of the volvis.org collection.
_RAW_LAYOUTS = {'2888630277536561269f9632164e4b21088ab00d': ((256, 256, 256), 'uint8')}


@dataclass(frozen=True)
class Volume:
    """A CT volume.

    Parameters
    ----------
    data : float32 [x, y, z]
        Density.
    spacing : tuple[float, float, float]
        Voxel size (x, y, z), mm.
    affine : float64 [4, 4]
        Voxel index to the centre of the voxel in the world, mm; NIfTI's axes (right, anterior, superior) for the medical formats.
    unit : str
        '1/mm'; 'normalised' for densities scaled to [0, 1]; or the description of a file of ours.
    """

    data: np.ndarray
    spacing: tuple[float, float, float]
    affine: np.ndarray
    unit: str

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """For a notebook: slices, each with a slider."""
        centre = self.affine[:3, :3] @ ((np.array(self.data.shape) - 1) / 2) + self.affine[:3, 3]
        return notebook.box(repr(self), notebook.slices(self.data, self.spacing, centre, self.unit))


def centred_affine(shape: Sequence[int], spacing: ArrayLike) -> np.ndarray:
    """The affine [4, 4] of a volume of `shape` voxels of `spacing` mm whose middle is the world's origin."""
    spacing = np.asarray(spacing, float)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = spacing / 2 - np.asarray(shape) * spacing / 2
    return affine


# ---- values ------------------------------------------------------------------------------------------------


def _density(data, path, hu, mu_water, only_hu):
    """(float32 density, unit) by rules 2 and 3 of the module."""
    low, high = float(data.min()), float(data.max())
    if hu is None:
        hu = low <= -500
        # By value, not by type: a header's slope turns integers into floats.
        if not hu and low < 0 and (low < -0.1 * high or not (data != np.round(data)).any()):
            if mu_water is None:
                raise InputError(
                    f'{path}: holds negative values down to {low:g}, which may be Hounsfield units '
                    'or not; if they are, give mu_water=MU, the attenuation of water in 1/mm, '
                    'else set them to 0; in Python, hu=True or hu=False says which'
                )
            hu = True
    if hu:
        data = data.astype(np.float32)
        if mu_water is not None:
            return np.maximum((data + 1000) * np.float32(mu_water / 1000), 0), '1/mm'
        return (np.clip(data, -1000, 2000) + 1000) / 3000, 'normalised'
    if mu_water is not None and only_hu:
        raise InputError(
            f'{path}: mu_water={mu_water:g} was given, but the values ({low:g} to {high:g}) do not '
            'look like Hounsfield units; leave it out, or in Python say hu=True'
        )
    if not high > 0:
        raise InputError(f'{path}: the volume is empty: no value is above 0')
    keep = data.dtype.kind == 'f' and high <= 1
    if mu_water is not None and not keep:
        raise InputError(
            f"{path}: its values, up to {high:g}, are not attenuation per mm, so units='hu' cannot be written: leave out "
            'units and mu_water'
        )
    data = np.maximum(data.astype(np.float32), 0)
    return (data if keep else data / np.float32(high)), 'normalised'


# ---- NumPy's archive and raw bytes -------------------------------------------------------------------------


def _npz(path):
    volumes = [a for a in arrays.read_npz(path).values() if a.ndim == 3]
    if len(volumes) != 1:
        raise InputError(f'{path}: holds {len(volumes)} arrays of 3 dimensions; save exactly one')
    return volumes[0]


def git_blob_sha1(content: bytes) -> str:
    """The name that git gives to a file of this content."""
    return hashlib.sha1(b'blob %d\0' % len(content) + content).hexdigest()


def _raw(path, shape, dtype):
    with reading(path):
        size = os.path.getsize(path)
    if shape is None or dtype is None:
        layout = None
        if size in {math.prod(s) * np.dtype(d).itemsize for s, d in _RAW_LAYOUTS.values()}:
            with reading(path):
                layout = _RAW_LAYOUTS.get(git_blob_sha1(Path(path).read_bytes()))
        if layout is None:
            raise InputError(f'{path}: raw bytes have no header; give the shape (x, y, z) and the dtype')
        shape, dtype = layout
    try:
        dtype_text, shape = dtype, tuple(int(n) for n in shape)
        dtype = np.dtype(dtype_text)
    except Exception:  # for a text that is not a type, NumPy raises many kinds, SyntaxError among them
        raise InputError(
            f'{path}: shape {shown(shape)} or dtype {shown(dtype)} is not understood; give for example (256, 256, 256) '
            'and uint8'
        ) from None
    if dtype.kind not in 'buif':
        raise InputError(
            f'{path}: the dtype of raw bytes must be one of real numbers, such as uint8, not {shown(dtype_text)}'
        )
    if len(shape) != 3 or min(shape) < 1:
        raise InputError(f'{path}: the shape must be 3 positive numbers (x, y, z), not {shown(shape)}')
    expected = math.prod(shape) * dtype.itemsize
    if size != expected:
        raise InputError(
            f'{path}: has {size} bytes, but {shape} of {dtype} needs {expected}; correct the shape or the dtype'
        )
    return read_voxels(path, 0, shape, dtype)


# ---- in and out --------------------------------------------------------------------------------------------


def read_volume(
    path: PathLike | str,
    mu_water: float | None = None,
    shape: Sequence[int] | None = None,
    dtype: Any = None,
    spacing: ArrayLike | None = None,
    hu: bool | None = None,
    only_hu: bool = True,
) -> Volume:
    """Reads a CT volume; the format follows from the name.

    Values become densities by the rules of the module.

    Parameters
    ----------
    path : path-like
        .nii, .nii.gz, .hdr/.img; .nrrd, .nhdr, .mha, .mhd; .ome.zarr (zarr); .npy, .npz with one 3D array, [x, y, z]; .tif, .tiff
        or a folder of them, [z][y, x], sorted by name (tifffile); a folder of DICOM slices, sorted by position (pydicom); .raw,
        or any file if shape and dtype are given.
    mu_water : float or None
        Attenuation of water, 1/mm: Hounsfield units become density in 1/mm instead of [0, 1].
    shape : Sequence[int] or None
        Shape of raw bytes, (x, y, z), x fastest.
    dtype
        NumPy type of raw bytes, such as 'uint8' or '>u2'; neither is needed for the well-known 256^3 `foot`.
    spacing : array_like or None
        Voxel size in mm, one number or (x, y, z), for formats without it (default: 1 mm, with a warning); TIFF has it where
        ImageJ or OME wrote it.
    hu : bool or None
        Whether the values are Hounsfield units, if that is not clear from the values.
    only_hu : bool
        Whether `mu_water` is refused for other values. If not, floats up to 1 are read as densities per mm.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty, not 3D, not finite or ambiguous, slices are unevenly spaced, or a package of the
        `formats` extra is missing.
    """
    path = Path(path)
    name, description, affine, tiff = path.name.lower(), '', None, None
    if mu_water is not None and not (np.isfinite(mu_water) and mu_water > 0):
        raise InputError(f'mu_water must be positive, in 1/mm, not {shown(mu_water)}; water at 60 keV has 0.0206')
    if (shape is None) != (dtype is None) and not name.endswith('.raw'):
        raise InputError(f'{path}: the shape and the dtype of raw bytes go together; give both or neither')
    if name.endswith('.zarr'):
        data, affine, description = ome_zarr.read_ome_zarr(path)
    elif path.is_dir():
        data, affine, tiff = slices.read_folder(path)
        hu = True if hu is None and affine is not None else hu  # DICOM has HU
    elif shape is not None and dtype is not None or name.endswith('.raw'):
        data = _raw(path, shape, dtype)
    elif name.endswith(('.nii', '.nii.gz', '.hdr', '.img')):
        data, affine, description = read_nifti(path)
    elif name.endswith(('.nrrd', '.nhdr', '.mha', '.mhd')):
        data, affine = (read_nrrd if name.endswith(('.nrrd', '.nhdr')) else read_metaimage)(path)
        affine = LPS_TO_RAS @ affine
    elif name.endswith('.npy'):
        data = arrays.read_npy(path, 3)
    elif name.endswith('.npz'):
        data = _npz(path)
    elif name.endswith(('.tif', '.tiff')):
        data, tiff = slices.read_tiff([path]), path
    elif name.endswith('.dcm'):
        raise InputError(f'{path}: is a single DICOM slice; give the folder of the series')
    else:
        with reading(path):
            open(path, 'rb').close()
        raise InputError(
            f'{path}: is not a known volume format; give .nii.gz, .nrrd, .mhd, .npy, .tif, a '
            'folder of slices, or shape and dtype of raw bytes'
        )
    data = numeric(data, path, 3)
    if tiff is not None and (steps := slices.tiff_spacing(tiff)) is not None:
        x, y, z = steps
        if z is not None:
            affine = centred_affine(data.shape, (x, y, z))
        elif spacing is None:
            raise InputError(
                f'{path}: its pixels are {x:g} x {y:g} mm, but it does not say how far its slices are apart: give '
                f'spacing=({x:g}, {y:g}, MM)'
            )
    if affine is None:
        if spacing is None:
            warnings.warn(
                f'{path}: does not say its voxel size, and 1 mm is taken: give spacing=MM, or a format that has it',
                stacklevel=2,
            )
        try:
            steps = np.atleast_1d(np.asarray(1.0 if spacing is None else spacing, float))
        except (TypeError, ValueError):
            steps = np.empty(0)
        if steps.shape not in ((1,), (3,)) or not (np.isfinite(steps).all() and steps.min() > 0):
            raise InputError(f'spacing must be one or three positive numbers, in mm, not {shown(spacing)}')
        affine = centred_affine(data.shape, np.broadcast_to(steps, 3))
    elif spacing is not None:
        raise InputError(f'{path}: carries its own voxel size; leave spacing out')
    sides = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.isfinite(affine).all() or not sides.min() > 0:
        raise InputError(f'{path}: the header has no valid voxel size; correct its affine')
    if description.startswith(_OURS) and data.dtype.kind == 'f':
        density, unit = data.astype(np.float32), description[len(_OURS) :]
        if (of_file := Unit.described(unit)) is not None:
            density, unit = of_file.densities(density), PER_MM.description
    else:
        density, unit = _density(data, path, hu, mu_water, only_hu)
    x, y, z = (float(s) for s in sides)
    return Volume(np.ascontiguousarray(density, np.float32), (x, y, z), affine, unit)


def write_volume(path: PathLike | str, data: np.ndarray, grid: Grid, description: str = 'normalised') -> None:
    """Writes a float32 NIfTI file, whole or not at all, that `read_volume` returns unchanged.

    Parameters
    ----------
    path : path-like
        .nii or .nii.gz.
    data : ndarray [x, y, z]
        Finite.
    grid : Grid
        Its voxels.
    description : str
        Name of the values, for example 'normalised' or '1/mm'; about 65 bytes fit.

    Raises
    ------
    InputError
        For another suffix, a shape that is not the grid's, values that are not finite, or a file that cannot be written.
    """
    import nibabel

    path = Path(path)
    if not path.name.endswith(('.nii', '.nii.gz')):
        raise InputError(f'{path}: volumes are written as NIfTI; give a name that ends in .nii or .nii.gz')
    data = numeric(np.asarray(data), path, 3)
    if data.shape != grid.shape:
        raise InputError(f'{path}: values of the shape {data.shape} do not make {grid.shape} voxels')
    affine, text = _placed(path, grid, description)
    image = nibabel.Nifti1Image(np.asarray(data, np.float32), affine)
    image.header.set_xyzt_units('mm')
    image.header['descrip'] = text
    with replacing(path) as temporary:
        nibabel.save(image, temporary)


def volume_header(path: PathLike | str, grid: Grid, description: str) -> bytes:
    """Return the header of the file that `write_volume` writes. The voxels follow it as little-endian float32, x fastest.

    The arguments and errors are the same as for `write_volume`.
    """
    import nibabel

    affine, text = _placed(Path(path), grid, description)
    header: Any = nibabel.Nifti1Header(endianness='<')
    header.set_data_dtype(np.float32)
    header.set_data_shape(grid.shape)
    header.set_qform(affine, 'unknown')
    header.set_sform(affine, 'aligned')
    header.set_xyzt_units('mm')
    header['descrip'], header['magic'], header['vox_offset'] = text, b'n+1', len(header.binaryblock) + 4
    header.set_slope_inter(1, 0)
    return header.binaryblock + bytes(4)  # no extensions


def _placed(path: Path, grid: Grid, description: str):
    """The affine [4, 4] and the description of a NIfTI file, checked."""
    if max(grid.shape) > np.iinfo(np.int16).max:
        raise InputError(f'{path}: NIfTI has room for {np.iinfo(np.int16).max} voxels along a side; write .ome.zarr')
    affine = np.diag([*grid.spacing, 1.0])
    affine[:3, 3] = grid.first_voxel
    text = (_OURS + description).encode('utf-8')
    if len(text) > 79:
        raise InputError(f'{path}: the description is {len(text)} bytes long with its prefix; NIfTI has room for 79')
    return affine, text
