"""NRRD: .nrrd, and .nhdr with its voxels in another file. Raw, gzip or bzip2, three dimensions, one value a voxel.

The header is text, "field: value" lines, and ends with an empty line. Voxels stand behind it, or in a file beside or below the
header. https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files.voxels import read_voxels
from lingo_mi.storage.file_access import beside, reading

_LONGEST_HEADER = 1 << 16
_TYPES = {
    'i1': 'signed char, int8, int8_t',
    'u1': 'uchar, unsigned char, uint8, uint8_t',
    'i2': 'short, short int, signed short, signed short int, int16, int16_t',
    'u2': 'ushort, unsigned short, unsigned short int, uint16, uint16_t',
    'i4': 'int, signed int, int32, int32_t',
    'u4': 'uint, unsigned int, uint32, uint32_t',
    'i8': 'longlong, long long, long long int, signed long long, signed long long int, int64, int64_t',
    'u8': 'ulonglong, unsigned long long, unsigned long long int, uint64, uint64_t',
    'f4': 'float',
    'f8': 'double',
}
_NAMES = {name: kind for kind, names in _TYPES.items() for name in names.split(', ')}
_PACKINGS = {'raw': None, 'gzip': 'deflate', 'gz': 'deflate', 'bzip2': 'bzip2', 'bz2': 'bzip2'}
_UNITS = {'mm': 1.0, 'um': 1e-3, 'microns': 1e-3, 'micron': 1e-3, 'nm': 1e-6, 'cm': 10.0, 'm': 1e3, '': 1.0}  # in mm
# Signs that turn the space's axes into left, posterior, superior; those of others are taken as they are.
_TO_LPS = {
    'right-anterior-superior': (-1, -1, 1),
    'ras': (-1, -1, 1),
    'left-anterior-superior': (1, -1, 1),
    'las': (1, -1, 1),
}


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The values [x, y, z] and the affine [4, 4] in mm, axes left, posterior, superior.

    Raises InputError where a file is missing, damaged or another one, or says what is not read here.
    """
    with reading(path), open(path, 'rb') as stream:
        fields, end = _fields(stream.read(_LONGEST_HEADER), path)

    def fail(what):
        raise InputError(f'{path}: {what}; correct the header')

    def numbers(name, default, count):
        if name not in fields:
            return np.array(default, float)
        try:
            values = np.array([float(x) for x in re.split(r'[\s(),]+', fields[name]) if x])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            fail(f'{name} must be {count} finite number{"s" * (count > 1)}, not {shown(fields[name])}')
        return values

    def whole(name, default, count):
        values = numbers(name, default, count)
        if (values % 1).any() or (np.abs(values) > 2**53).any():
            fail(f'{name} must be whole numbers, not {shown(fields[name])}')
        return [int(x) for x in values]

    (dimensions,) = whole('dimension', [0], 1)
    kinds = fields.get('kinds', '').lower().split()
    if dimensions != 3 or set(kinds) - {'domain', 'space', 'time', '???', 'none'}:
        fail(f'has {dimensions} dimensions ({" ".join(kinds) or "no kinds"}); a 3D volume of single values is needed')
    kind = fields.get('type', '').lower()
    if kind not in _NAMES:
        fail(f'type must be one of {", ".join(names.split(",")[0] for names in _TYPES.values())}, not {shown(kind)}')
    encoding = fields.get('encoding', '').lower()
    if encoding not in _PACKINGS:
        fail(f'encoding must be raw, gzip or bzip2, not {shown(encoding)}')
    sizes = whole('sizes', [0, 0, 0], 3)
    if min(sizes) < 1:
        fail(f'sizes must be 3 numbers from 1 on, not {shown(fields.get("sizes", ""))}')
    endian = fields.get('endian', 'little').lower()
    if endian not in ('little', 'big'):
        fail(f'endian must be little or big, not {shown(fields["endian"])}')
    dtype = np.dtype(_NAMES[kind]).newbyteorder('>' if endian == 'big' else '<')
    packing, skip = _PACKINGS[encoding], whole('byte skip', [0], 1)[0]
    if whole('line skip', [0], 1)[0] or skip < -1 or skip and packing:
        fail('line skip, and the byte skip of compressed voxels, must be 0')
    name = fields.get('data file')
    if name is None:
        file = path
        skip = skip if skip < 0 else end + skip
    elif name.upper().startswith('LIST') or '%' in name:
        fail('data file names several files, which are not read; write one file of voxels')
    else:
        file = beside(path, name)
    data = read_voxels(file, skip, sizes, dtype, packing)
    affine = np.eye(4)
    if 'space directions' in fields:
        affine[:3, :3] = numbers('space directions', None, 9).reshape(3, 3).T
        affine[:3, 3] = numbers('space origin', [0, 0, 0], 3)
        affine[:3] *= np.reshape(_TO_LPS.get(fields.get('space', '').lower(), (1, 1, 1)), (3, 1))
    elif 'axis mins' in fields or 'axis maxs' in fields:
        fail('axis mins and maxs are not read; say the voxel size by spacings or space directions')
    else:
        affine[:3, :3] = np.diag(numbers('spacings', [1, 1, 1], 3))
    units = re.findall(r'"([^"]*)"', fields.get('space units', fields.get('units', '')))
    if len(set(units)) > 1 or any(unit.lower() not in _UNITS for unit in units):
        fail(f'units must be one of {", ".join(filter(None, _UNITS))} for all axes, not {shown(", ".join(units))}')
    affine[:3] *= _UNITS[units[0].lower()] if units else 1.0
    return data, affine


def _fields(block: bytes, path: Path) -> tuple[dict[str, str], int]:
    """The header's values by field, and where it ends."""
    found = re.search(rb'\r?\n\r?\n', block)
    end = found.end() if found else len(block)
    lines = block[:end].decode('latin1').splitlines()
    if not re.fullmatch(r'NRRD000\d', lines[0].strip() if lines else '') or not found and len(block) == _LONGEST_HEADER:
        raise InputError(f'{path}: is damaged or not an NRRD file; fetch it again')
    fields = {}
    for line in lines[1:]:
        name, colon, value = line.partition(':')
        if colon and not line.startswith('#') and not value.startswith('='):
            fields[name.strip().lower().replace('datafile', 'data file')] = value.strip()
    return fields, end
