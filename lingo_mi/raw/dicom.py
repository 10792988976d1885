"""Frames in DICOM files: frames of angiography (`dicom_xa`), and projections of a CT scanner (`dicom_ct_pd`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.slices import by_number, read_dicom_file
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.raw import dicom_ct_pd, dicom_xa
from lingo_mi.raw.recording import Frames, Recording, Taken, checked
from lingo_mi.storage.file_access import one_line, optional, reading

SUFFIXES = '.dcm', '.ima'
_PREAMBLE = 128  # bytes before the letters DICM


@dataclass(frozen=True)
class _Kind:
    """Properties of a kind of projections.

    numbers(file, header): what is kept of a header, small, as a scan may have 50 000 files.
    values(numbers, pixels): counts, or shares of the unattenuated beam, of stored pixels.
    taken(path, list of numbers): where the frames were taken.
    """

    numbers: Callable[[Path, Any], Any]
    values: Callable[[Any, np.ndarray], np.ndarray]
    taken: Callable[[Path, list], Taken]
    transmission: bool


_CT_PD = _Kind(dicom_ct_pd.numbers, dicom_ct_pd.transmission, dicom_ct_pd.taken, True)
_XA = _Kind(dicom_xa.numbers, dicom_xa.counts, dicom_xa.taken, False)


def is_dicom(path: Path) -> bool:
    """Return whether a file is in DICOM's format, by its suffix or its first bytes: scanners often write no suffix."""
    if path.suffix.lower() in SUFFIXES:
        return True
    if not path.is_file() or path.name.upper() == 'DICOMDIR':  # the index of a disk
        return False
    with reading(path), open(path, 'rb') as stream:
        return stream.read(_PREAMBLE + 4)[_PREAMBLE:] == b'DICM'


def open_file(path: Path) -> Recording:
    """`open_dicom` of one file."""
    return open_dicom(path, [path])


def open_dicom(path: Path, files: Iterable[Path]) -> Recording:
    """The frames of DICOM files, in the order of InstanceNumber, or else of the numbers in their names.

    Parameters
    ----------
    path : Path
        The file or the folder that was asked for, for messages.
    files : iterable of Path
        At least one.

    Raises
    ------
    InputError
        If a file is damaged, holds no projections, or is of another kind than the first.
    """
    entries: list[tuple[Any, Path, int, Any]] = []
    kind = None
    for file in sorted(files, key=by_number):
        header = read_dicom_file(file, pixels=False)
        if header is None:
            raise InputError(f'{file}: is not a DICOM file; export it again, or take it out of the folder')
        reader = _CT_PD if dicom_ct_pd.is_projection(header) else _XA
        if kind not in (None, reader):
            raise InputError(
                f'{file}: is of another kind than {entries[0][1].name}; put one scan in a folder of its own'
            )
        kind = reader
        if not header.get('Rows') or not header.get('Columns') or header.get('SamplesPerPixel', 1) != 1:
            raise InputError(f'{file}: has no image of one value a pixel; take it out of the folder')
        count = checked(file, lambda: int(header.get('NumberOfFrames') or 1))
        if not 1 <= count <= MOST_VIEWS:
            raise InputError(f'{file}: NumberOfFrames (0028,0008) must be from 1 to {MOST_VIEWS}, not {count}')
        numbers = checked(file, lambda: reader.numbers(file, header))
        entries.append((header.get('InstanceNumber'), file, count, numbers))
    assert kind is not None
    if all(number is not None for number, *_ in entries):
        entries.sort(key=lambda entry: int(entry[0]))
    places = [(i, k) for i, (_, _, count, _) in enumerate(entries) for k in range(count)]

    def read(i):
        place, k = places[i]
        _, file, count, numbers = entries[place]
        return kind.values(numbers, _pixels(file, k if count > 1 else 0))

    first = read(0)
    views = Frames(str(path), len(places), first.shape, first.dtype, read)
    taken = partial(kind.taken, path, [numbers for *_, numbers in entries])
    return Recording(views, taken=taken, transmission=kind.transmission)


def _pixels(file, k):
    """Frame k of a file, as its pixels are stored."""
    try:
        return optional('pydicom.pixels').pixel_array(file, index=k)
    except Exception as error:  # pydicom and its decompressors fail in many ways
        text = one_line(error)[:120]
        raise InputError(f'{file}: its pixels cannot be read ({text}); copy or export it again, uncompressed') from None
