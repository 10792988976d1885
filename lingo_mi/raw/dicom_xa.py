"""Frames of a C-arm in DICOM: X-ray angiography (XA), one frame a file or many, and its enhanced form.

Angles of the positioner are the detector's, as seen by the patient: the primary one is 0 before the chest and 90 degrees at the
left hand, the secondary one is positive towards the head (DICOM PS3.3, C.8.7.5.1.2). Here the patient's right, front and head are
x, y and z, so the source is at the primary angle less 90 degrees, and as far below the plane as the detector is above it.
Columns run to the patient's left in a view of the chest, and rows to the feet, unless PatientOrientation says otherwise.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.raw.dicom_header import floats, needed
from lingo_mi.raw.recording import Taken
from lingo_mi.storage.file_access import optional

_PRIMARY, _SECONDARY = 'PositionerPrimaryAngle', 'PositionerSecondaryAngle'
_NAMED = {
    _PRIMARY: f'{_PRIMARY} (0018,1510)',
    _PRIMARY + 'Increment': f'{_PRIMARY}Increment (0018,1520)',
    _SECONDARY: f'{_SECONDARY} (0018,1511)',
    'DSO': 'DistanceSourceToPatient (0018,1111)',
    'DSD': 'DistanceSourceToDetector (0018,1110)',
    'ImagerPixelSpacing': 'ImagerPixelSpacing (0018,1164)',
}
_TOWARDS = dict(R=(1, 0, 0), L=(-1, 0, 0), A=(0, 1, 0), P=(0, -1, 0), H=(0, 0, 1), F=(0, 0, -1))
_FEW = 1e-6  # mm and degrees, for numbers that are the same in all files


@dataclass(frozen=True)
class _Run:
    """One file: `values` by the names of _NAMED, angles [frames]; `lut` a dataset of the LUT that makes counts."""

    file: Path
    frames: int
    shape: tuple[int, int]
    values: dict[str, np.ndarray | None]
    orientation: tuple[str, ...] | None  # of rows and of columns
    slope: float
    intercept: float
    lut: Any


def numbers(file: Path, header: Any) -> _Run:
    """Return the numbers of a header that an import needs: see `lingo_mi.raw.dicom`.

    Raises
    ------
    InputError
        If it is not a projection, or its pixels do not grow with the counts.
    """
    if _attribute(header, 0, 'ImagePositionPatient') is not None:
        name = header.get('SOPClassUID')
        raise InputError(
            f'{file}: is not a projection, but a slice or a volume ({getattr(name, "name", "of no class")}): read it as a volume'
        )
    relation, lut = header.get('PixelIntensityRelationship') or 'LIN', None
    if relation != 'LIN':
        if 'ModalityLUTSequence' not in header:
            raise InputError(
                f'{file}: PixelIntensityRelationship (0028,1040) is {shown(relation)}, and no ModalityLUTSequence says how '
                'to return to counts; export the frames as LIN'
            )
        lut = optional('pydicom').Dataset()
        lut.ModalityLUTSequence = header.ModalityLUTSequence
    elif header.get('PixelIntensityRelationshipSign') == -1:
        raise InputError(f'{file}: its pixels fall with the intensity (0028,1041); export the frames with rising ones')
    n = int(header.get('NumberOfFrames') or 1)
    distances = {
        'DSO': ('DistanceSourceToPatient', 'DistanceSourceToIsocenter'),
        'DSD': ('DistanceSourceToDetector',),
        'ImagerPixelSpacing': ('ImagerPixelSpacing',),
    }
    values = {key: floats(_first(_attribute(header, 0, name) for name in names)) for key, names in distances.items()}
    values |= _angles(header, n)
    for name in 'DetectorPrimaryAngle', 'DetectorSecondaryAngle':
        tilted = floats(_attribute(header, 0, name))
        if tilted is not None and tilted.any():
            warnings.warn(f'{file}: {name} is not read: calibrate the scan if its axis is off', stacklevel=2)
    orientation = header.get('PatientOrientation')
    oriented = tuple(map(str, orientation)) if orientation is not None and len(orientation) == 2 else None
    return _Run(
        file, n, (int(header.Rows), int(header.Columns)), values, oriented,
        float(header.get('RescaleSlope', 1)), float(header.get('RescaleIntercept', 0)), lut,
    )  # fmt: skip


def counts(run: _Run, pixels: np.ndarray) -> np.ndarray:
    """Counts [v, u] of stored pixels."""
    if run.lut is not None:
        return optional('pydicom.pixels').apply_modality_lut(pixels, run.lut)
    return pixels if (run.slope, run.intercept) == (1, 0) else run.slope * pixels + run.intercept


def taken(path: Path, runs: list[_Run]) -> Taken:
    """The C-arm of all frames.

    Raises
    ------
    InputError
        If an attribute is missing, or distances and pixels differ between files.
    """
    first = runs[0]

    def once(name, count=1):
        values = np.stack([needed(run.file, _NAMED[name], run.values[name], count) for run in runs])
        if np.ptp(values, axis=0).max() > _FEW:
            raise InputError(f'{path}: {_NAMED[name]} differs between the files; give one scan, or geometry=FILE')
        return values[0]

    primary = np.concatenate([needed(run.file, _lacking(run), run.values[_PRIMARY], run.frames) for run in runs])
    tilt = [np.zeros(run.frames) if run.values[_SECONDARY] is None else run.values[_SECONDARY] for run in runs]
    secondary = np.concatenate(
        [needed(run.file, _NAMED[_SECONDARY], values, run.frames) for run, values in zip(runs, tilt)]
    )
    scanner: dict[str, Any] = dict(
        DSO=float(once('DSO')[0]),
        DSD=float(once('DSD')[0]),
        nDetector=list(first.shape),
        dDetector=once('ImagerPixelSpacing', 2).tolist(),
        angles=(primary - 90).tolist(),
    )
    if np.abs(secondary).max() > _FEW:
        scanner['tilt'] = (-secondary).tolist()
    columns, rows = -1, 1
    if first.orientation is not None:
        a, across, down = np.radians(primary[0] - 90), *(_vector(letters) for letters in first.orientation)
        columns = 1 if across @ (-np.sin(a), np.cos(a), 0) > _FEW else -1
        rows = -1 if down[2] > _FEW else 1
    return Taken(scanner, columns, rows)


def _vector(letters):
    return np.sum([_TOWARDS.get(letter, (0, 0, 0)) for letter in letters.upper()] or [(0, 0, 0)], axis=0)


def _lacking(run):
    """The attribute without which there are no primary angles."""
    return _NAMED[_PRIMARY + ('Increment' if run.frames > 1 and run.values['first'] is not None else '')]


def _angles(header, n):
    """The angles of n frames by name, None if they are missing; `first`: the primary one of the first frame."""
    out = {'first': floats(_attribute(header, 0, _PRIMARY))}
    for name in _PRIMARY, _SECONDARY:
        start, steps = floats(header.get(name)), floats(header.get(name + 'Increment'))
        if 'PerFrameFunctionalGroupsSequence' in header:
            values = [value for k in range(n) if (value := floats(_attribute(header, k, name))) is not None]
            out[name] = np.concatenate(values) if len(values) == n else None
        elif start is None or (steps is None and n > 1 and name == _PRIMARY):
            out[name] = None
        elif steps is None:
            out[name] = np.repeat(start[:1], n)
        else:  # one step for all, or offsets from the first angle (C.8.7.5.1.3)
            out[name] = start[0] + (steps * np.arange(n) if len(steps) == 1 else steps)
    return out


def _attribute(header, k, name):
    """An attribute of frame k: its own, one that all frames share, or the file's; None if it has none."""
    frames, shared = (header.get(f'{of}FunctionalGroupsSequence') for of in ('PerFrame', 'Shared'))
    groups = [*(frames or [])[k : k + 1], *(shared or [])[:1]]
    return _first(value for value in [*(_within(group, name) for group in groups), header.get(name)])


def _within(group, name):
    """The first attribute of this name in an item or in the items of its sequences."""
    if group.get(name) is not None:
        return group.get(name)
    items = (item for element in group if element.VR == 'SQ' for item in element.value)
    return _first(_within(item, name) for item in items)


def _first(values):
    return next((value for value in values if value is not None), None)
