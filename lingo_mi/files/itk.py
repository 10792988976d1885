"""MetaImage (.mha, and .mhd beside its voxels) and NRRD (.nrrd, and .nhdr): three dimensions, one value a voxel.

Headers are text: "Name = value" lines up to ElementDataFile (MetaImage, https://itk.org/Wiki/ITK/MetaIO/Documentation), or
"field: value" lines up to an empty one (NRRD, https://teem.sourceforge.net/nrrd/format.html). Voxels are raw, zlib's, gzip's or
bzip2's, behind the header or in a file beside or below it; lists and patterns of files are refused.

The libraries fail on hostile headers: SimpleITK crashes on `ElementDataFile = %n%s`, hangs on `NDims = 4294967296`, and takes
damaged gzip for voxels; pynrrd opens `data file: /etc/hostname`, and unpacks without a bound.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files.voxels import read_voxels
from lingo_mi.storage.file_access import beside, reading

_LONGEST_HEADER = 1 << 16
_METAIMAGE_TYPES = dict(
    MET_CHAR='i1', MET_UCHAR='u1', MET_SHORT='i2', MET_USHORT='u2', MET_INT='i4', MET_UINT='u4', MET_LONG='i4',
    MET_ULONG='u4', MET_LONG_LONG='i8', MET_ULONG_LONG='u8', MET_FLOAT='f4', MET_DOUBLE='f8',
)  # fmt: skip
_METAIMAGE_UNITS = {'mm': 1.0, 'um': 1e-3, 'cm': 10.0, '?': 1.0}  # in mm
_NRRD_TYPES = {
    name: kind
    for kind, names in dict(
        i1='signed char, int8, int8_t',
        u1='uchar, unsigned char, uint8, uint8_t',
        i2='short, short int, signed short, signed short int, int16, int16_t',
        u2='ushort, unsigned short, unsigned short int, uint16, uint16_t',
        i4='int, signed int, int32, int32_t',
        u4='uint, unsigned int, uint32, uint32_t',
        i8='longlong, long long, long long int, signed long long, signed long long int, int64, int64_t',
        u8='ulonglong, unsigned long long, unsigned long long int, uint64, uint64_t',
        f4='float',
        f8='double',
    ).items()
    for name in names.split(', ')
}
_NRRD_PACKINGS = {'raw': None, 'gzip': 'deflate', 'gz': 'deflate', 'bzip2': 'bzip2', 'bz2': 'bzip2'}
_NRRD_UNITS = {'mm': 1.0, 'um': 1e-3, 'microns': 1e-3, 'micron': 1e-3, 'nm': 1e-6, 'cm': 10.0, 'm': 1e3, '': 1.0}
# Signs that turn the space's axes into left, posterior, superior. Axes of other spaces are taken as they are.
_NRRD_TO_LPS = {
    'right-anterior-superior': (-1, -1, 1),
    'ras': (-1, -1, 1),
    'left-anterior-superior': (1, -1, 1),
    'las': (1, -1, 1),
}


def read_metaimage(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The values [x, y, z] and the affine [4, 4] in mm, ITK's axes (left, posterior, superior).

    Raises
    ------
    InputError
        If a file is missing, damaged or another one, or says what is not read here.
    """
    with reading(path), open(path, 'rb') as stream:
        header, end = _metaimage_header(stream.read(_LONGEST_HEADER), path)
    fields = header.fields

    def true(*names):
        return any(fields.get(name, 'False').lower() in ('true', 't', '1') for name in names)

    (dimensions,), (channels,) = header.numbers([0], 'NDims'), header.numbers([1], 'ElementNumberOfChannels')
    if dimensions != 3 or channels != 1:
        header.refuse(
            f'has {dimensions:g} dimensions and {channels:g} values a voxel; a 3D volume of single values is needed'
        )
    kind = header.choice(_METAIMAGE_TYPES, 'ElementType', fields.get('ElementType', ''))
    if not true('BinaryData') and 'BinaryData' in fields:
        header.refuse('BinaryData must be True: numbers as text are not read')
    dtype = np.dtype(kind).newbyteorder('>' if true('BinaryDataByteOrderMSB', 'ElementByteOrderMSB') else '<')
    sizes, (start,) = header.whole('DimSize', [0, 0, 0], 1), header.whole('HeaderSize', [0], -1)
    packing = 'deflate' if true('CompressedData') else None
    if start < 0 and packing:
        header.refuse('HeaderSize of compressed voxels must be 0 or more')
    if fields['ElementDataFile'].upper() == 'LOCAL':
        data = read_voxels(path, start or end, sizes, dtype, packing)
    else:
        data = read_voxels(header.voxel_file('ElementDataFile'), start, sizes, dtype, packing)
    affine = np.eye(4)
    # A row of TransformMatrix is the direction of an axis.
    matrix = header.numbers(np.eye(3), 'TransformMatrix', 'Rotation', 'Orientation').reshape(3, 3)
    affine[:3, :3] = matrix.T * header.numbers([1, 1, 1], 'ElementSpacing', 'ElementSize')
    affine[:3, 3] = header.numbers([0, 0, 0], 'Offset', 'Position', 'Origin')
    affine[:3] *= header.choice(_METAIMAGE_UNITS, 'DistanceUnits', fields.get('DistanceUnits', 'mm'))
    return data, affine


def read_nrrd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The values [x, y, z] and the affine [4, 4] in mm, axes left, posterior, superior.

    Raises
    ------
    InputError
        If a file is missing, damaged or another one, or says what is not read here.
    """
    with reading(path), open(path, 'rb') as stream:
        header, end = _nrrd_header(stream.read(_LONGEST_HEADER), path)
    fields = header.fields
    (dimensions,), kinds = header.numbers([0], 'dimension'), fields.get('kinds', '').lower().split()
    if dimensions != 3 or set(kinds) - {'domain', 'space', 'time', '???', 'none'}:
        header.refuse(
            f'has {dimensions:g} dimensions ({" ".join(kinds) or "no kinds"}); a 3D volume of single values is needed'
        )
    kind = header.choice(_NRRD_TYPES, 'type', fields.get('type', '').lower())
    packing = header.choice(_NRRD_PACKINGS, 'encoding', fields.get('encoding', '').lower())
    order = header.choice({'little': '<', 'big': '>'}, 'endian', fields.get('endian', 'little').lower())
    sizes, (skip,) = header.whole('sizes', [0, 0, 0], 1), header.whole('byte skip', [0], -1)
    if header.numbers([0], 'line skip') != 0 or skip and packing or skip > 2**53:
        header.refuse('line skip, and the byte skip of compressed voxels, must be 0')
    if 'data file' in fields:
        file = header.voxel_file('data file')
    else:
        file, skip = path, skip if skip < 0 else end + skip
    data = read_voxels(file, skip, sizes, np.dtype(kind).newbyteorder(order), packing)
    affine = np.eye(4)
    if 'space directions' in fields:
        affine[:3, :3] = header.numbers(np.eye(3), 'space directions').reshape(3, 3).T
        affine[:3, 3] = header.numbers([0, 0, 0], 'space origin')
        affine[:3] *= np.reshape(_NRRD_TO_LPS.get(fields.get('space', '').lower(), (1, 1, 1)), (3, 1))
    elif 'axis mins' in fields or 'axis maxs' in fields:
        header.refuse('axis mins and maxs are not read; say the voxel size by spacings or space directions')
    else:
        affine[:3, :3] = np.diag(header.numbers([1, 1, 1], 'spacings'))
    units = {*re.findall(r'"([^"]*)"', fields.get('space units', fields.get('units', '')).lower())}
    affine[:3] *= header.choice(_NRRD_UNITS, 'units', ', '.join(sorted(units)))  # one for all axes
    return data, affine


class _Header:
    """The fields of the file `path` by name, as text."""

    def __init__(self, path: Path, fields: dict[str, str]) -> None:
        self.path, self.fields = path, fields

    def refuse(self, what: str) -> NoReturn:
        """Raises InputError in the name of the file."""
        raise InputError(f'{self.path}: {what}; correct the header')

    def numbers(self, default: ArrayLike, *names: str) -> np.ndarray:
        """The finite numbers of the first of these fields that is there, as many as the default has."""
        text, count = next((self.fields[name] for name in names if name in self.fields), None), np.size(default)
        if text is None:
            return np.array(default, float)
        try:
            values = np.array([float(x) for x in re.split(r'[\s(),]+', text) if x])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            self.refuse(f'{names[0]} must be {count} finite number{"s" * (count > 1)}, not {shown(text)}')
        return values

    def whole(self, name: str, default: list[int], least: int) -> list[int]:
        """Whole numbers from `least` on."""
        values = self.numbers(default, name)
        if (values % 1).any() or values.min() < least:
            self.refuse(f'{name} must be whole numbers from {least} on, not {shown(self.fields.get(name, ""))}')
        return [int(x) for x in values]

    def choice(self, choices: dict[str, Any], name: str, text: str) -> Any:
        """The choice that the text of a field names. The message of the error lists one name of each choice."""
        if text not in choices:
            names = {choice: name for name, choice in reversed(choices.items())}
            self.refuse(f'{name} must be one of {", ".join(reversed(names.values()))}, not {shown(text)}')
        return choices[text]

    def voxel_file(self, name: str) -> Path:
        """The file that a field names, beside the header or in a folder below."""
        text = self.fields[name]
        if text.upper().split()[:1] == ['LIST'] or '%' in text:
            self.refuse(f'{name} names several files, which are not read; write one file of voxels')
        return beside(self.path, text)


def _metaimage_header(block: bytes, path: Path) -> tuple[_Header, int]:
    """The header's fields, and where it ends."""
    fields, end = {}, 0
    for line in block.split(b'\n'):
        name, equals, value = line.decode('latin1').partition('=')
        if line.strip() and not equals:
            break
        end += len(line) + 1
        fields[name.strip()] = value.strip()
        if name.strip() == 'ElementDataFile':
            return _Header(path, fields), min(end, len(block))
    raise InputError(f'{path}: is damaged or not a MetaImage file: its header has no end; fetch it again')


def _nrrd_header(block: bytes, path: Path) -> tuple[_Header, int]:
    """The header's fields, and where it ends."""
    blank = re.search(rb'\r?\n\r?\n', block)
    end = blank.end() if blank else len(block)
    lines = block[:end].decode('latin1').splitlines()
    if not re.fullmatch(r'NRRD000\d', lines[0].strip() if lines else '') or not blank and len(block) == _LONGEST_HEADER:
        raise InputError(f'{path}: is damaged or not an NRRD file; fetch it again')
    fields = {}
    for line in lines[1:]:
        name, colon, value = line.partition(':')
        if colon and not line.startswith('#') and not value.startswith('='):
            fields[name.strip().lower().replace('datafile', 'data file')] = value.strip()
    return _Header(path, fields), end
