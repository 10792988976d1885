"""A volume as a DICOM series: CT Image Storage, one file a slice, in Hounsfield units.

The voxels keep their order, so that `read_volume` returns them as they were. x and y of this package run to the patient's right
and front as in NIfTI, and DICOM's axes to the left and back: the image's rows and columns therefore run against its axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.units import Unit
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage.file_access import new_folder, optional

LEAST, MOST = np.iinfo(np.int16).min, np.iinfo(np.int16).max
# Attributes that DICOM asks for, even if their values are unknown.
REQUIRED = (
    *('PatientName', 'PatientID', 'PatientBirthDate', 'PatientSex', 'ReferringPhysicianName'),
    *('StudyDate', 'StudyTime', 'StudyID', 'AccessionNumber'),
    *('PositionReferenceIndicator', 'KVP', 'AcquisitionNumber'),
)
_CT = '1.2.840.10008.5.1.4.1.1.2'  # CT Image Storage
_EXPLICIT = '1.2.840.10008.1.2.1'  # little endian


def write_dicom(path: Path, grid: Grid, slabs: Iterable[tuple[int, np.ndarray]], unit: Unit) -> None:
    """Write a series into a new folder, whole or not at all.

    Parameters
    ----------
    slabs : iterable of (int, ndarray)
        First slices, and values [x, y, slices] in Hounsfield units. They are stored to 1 HU.
    unit : Unit
        Hounsfield units.

    Raises
    ------
    InputError
        For other units, for values that 16 bits do not hold, and for a folder that exists or cannot be written.
    """
    pydicom = optional('pydicom')
    require_hounsfield(path, unit)
    series = {name: pydicom.uid.generate_uid() for name in ('Study', 'Series', 'FrameOfReference')}
    with new_folder(path) as temporary:
        for begin, slab in slabs:
            for k in range(slab.shape[2]):
                file = _slice(pydicom, path, grid, begin + k, slab[:, :, k], series, unit)
                file.save_as(temporary / f'{begin + k + 1:04d}.dcm', enforce_file_format=True)


def require_hounsfield(path: Path, unit: Unit) -> None:
    """Raises InputError unless DICOM's CT images have this unit."""
    if unit.name != 'hu':
        raise InputError(
            f"{path}: CT images of DICOM are in Hounsfield units: give units='hu' and mu_water=MU, water's per mm"
        )


def _slice(pydicom, path, grid, k, values, series, unit) -> Any:
    low, high = float(values.min()), float(values.max())
    if low < LEAST or high > MOST:
        raise InputError(
            f'{path}: {low:.0f} to {high:.0f} HU do not fit into the 16 bits of DICOM: correct mu_water, or write .nii.gz'
        )
    (nx, ny, _), (dx, dy, dz) = grid.shape, grid.spacing
    x, y, z = grid.first_voxel
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = _CT, pydicom.uid.generate_uid()
    meta.TransferSyntaxUID = _EXPLICIT
    file = pydicom.dataset.Dataset()
    file.file_meta = meta
    file.SOPClassUID, file.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    for name in REQUIRED:
        setattr(file, name, None)
    for name, uid in series.items():
        setattr(file, f'{name}{"" if name == "FrameOfReference" else "Instance"}UID', uid)
    file.Modality, file.Manufacturer, file.PatientPosition = 'CT', 'lingo_mi', 'HFS'
    file.ImageType = ['DERIVED', 'SECONDARY', 'AXIAL']
    file.DerivationDescription = unit.description
    file.SeriesNumber, file.InstanceNumber = 1, k + 1
    number = pydicom.valuerep.DSfloat
    file.PixelSpacing = [number(d, auto_format=True) for d in (dy, dx)]  # between rows, between columns
    file.SliceThickness = file.SpacingBetweenSlices = number(dz, auto_format=True)
    file.ImageOrientationPatient = [-1, 0, 0, 0, -1, 0]
    file.ImagePositionPatient = [number(float(c), auto_format=True) for c in (-x, -y, z + k * dz)]
    file.Rows, file.Columns, file.SamplesPerPixel, file.PhotometricInterpretation = ny, nx, 1, 'MONOCHROME2'
    file.BitsAllocated, file.BitsStored, file.HighBit, file.PixelRepresentation = 16, 16, 15, 1
    file.RescaleSlope, file.RescaleIntercept, file.RescaleType = 1, 0, 'HU'
    file.PixelData = np.rint(values.T).astype('<i2').tobytes()
    return file
