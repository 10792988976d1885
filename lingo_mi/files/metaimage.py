"""MetaImage: .mha, and .mhd with its voxels in another file. Uncompressed or zlib, three dimensions, one value a voxel.

The header is text, "Name = value" lines, and ends with ElementDataFile: LOCAL, or a file beside or below the header. Lists and
patterns of files are refused. https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files.voxels import read_voxels
from lingo_mi.storage.file_access import beside, reading

_LONGEST_HEADER = 1 << 16
UNITS = {'mm': 1.0, 'um': 1e-3, 'cm': 10.0, '?': 1.0}  # in mm
_TYPES = {
    'MET_CHAR': 'i1',
    'MET_UCHAR': 'u1',
    'MET_SHORT': 'i2',
    'MET_USHORT': 'u2',
    'MET_INT': 'i4',
    'MET_UINT': 'u4',
    'MET_LONG': 'i4',
    'MET_ULONG': 'u4',
    'MET_LONG_LONG': 'i8',
    'MET_ULONG_LONG': 'u8',
    'MET_FLOAT': 'f4',
    'MET_DOUBLE': 'f8',
}


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The values [x, y, z] and the affine [4, 4] in mm, ITK's axes (left, posterior, superior).

    Raises InputError where a file is missing, damaged or another one, or says what is not read here.
    """
    with reading(path), open(path, 'rb') as stream:
        fields, end = _fields(stream.read(_LONGEST_HEADER), path)

    def fail(what):
        raise InputError(f'{path}: {what}; correct the header')

    def numbers(names, default, count=3):
        text = next((fields[name] for name in names if name in fields), None)
        if text is None:
            return np.array(default, float)
        try:
            values = np.array([float(x) for x in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            fail(f'{names[0]} must be {count} finite number{"s" * (count > 1)}, not {shown(text)}')
        return values

    def true(*names):
        return any(fields.get(name, 'False').lower() in ('true', 't', '1') for name in names)

    dimensions, channels = (numbers([name], [n], 1)[0] for name, n in (('NDims', 0), ('ElementNumberOfChannels', 1)))
    if dimensions != 3 or channels != 1:
        fail(f'has {dimensions:g} dimensions and {channels:g} values a voxel; a 3D volume of single values is needed')
    kind = fields.get('ElementType', '')
    if kind not in _TYPES:
        fail(f'ElementType must be one of {", ".join(_TYPES)}, not {shown(kind)}')
    if not true('BinaryData') and 'BinaryData' in fields:
        fail('BinaryData must be True: numbers as text are not read')
    sizes = numbers(['DimSize'], [0, 0, 0])
    if (sizes < 1).any() or (sizes % 1).any():
        fail(f'DimSize must be 3 whole numbers from 1 on, not {shown(fields.get("DimSize", ""))}')
    dtype = np.dtype(_TYPES[kind]).newbyteorder('>' if true('BinaryDataByteOrderMSB', 'ElementByteOrderMSB') else '<')
    start = int(numbers(['HeaderSize'], [0], 1)[0])
    name = fields['ElementDataFile']
    if name.upper() == 'LOCAL':
        file, start = path, end if start == 0 else start
    elif name.upper() == 'LIST' or '%' in name:
        fail('ElementDataFile names several files, which are not read; write one file of voxels')
    else:
        file = beside(path, name)
    packing = 'deflate' if true('CompressedData') else None
    if start < -1 or start < 0 and packing:
        fail(f'HeaderSize must be -1 or more (compressed: 0 or more), not {start}')
    data = read_voxels(file, start, [int(n) for n in sizes], dtype, packing)
    affine = np.eye(4)
    # A row of TransformMatrix is the direction of an axis.
    matrix = numbers(['TransformMatrix', 'Rotation', 'Orientation'], np.eye(3).ravel(), 9).reshape(3, 3)
    affine[:3, :3] = matrix.T * numbers(['ElementSpacing', 'ElementSize'], [1, 1, 1])
    affine[:3, 3] = numbers(['Offset', 'Position', 'Origin'], [0, 0, 0])
    unit = fields.get('DistanceUnits', 'mm')
    if unit not in UNITS:
        fail(f'DistanceUnits must be one of {", ".join(UNITS)}, not {shown(unit)}')
    affine[:3] *= UNITS[unit]
    return data, affine


def _fields(block: bytes, path: Path) -> tuple[dict[str, str], int]:
    """The header's values by name, and where it ends."""
    fields, at = {}, 0
    while 'ElementDataFile' not in fields:
        line_end = block.find(b'\n', at)
        if line_end < 0:
            line_end = len(block)
        line = block[at:line_end].decode('latin1')
        name, _, value = line.partition('=')
        if at >= len(block) or line.strip() and '=' not in line:
            raise InputError(f'{path}: is damaged or not a MetaImage file: its header has no end; fetch it again')
        at = line_end + 1
        fields[name.strip()] = value.strip()
    return fields, min(at, len(block))
