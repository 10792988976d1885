"""The .txrm and .xrm of Zeiss' Xradia microscopes: frames, their reference, and where they were taken, in an OLE2 container.

The names are the same as in `dxchange.read_txrm`. Distances are in mm; PixelSize, at the axis, is in micrometres.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.raw.recording import Frames, Recording, Taken
from lingo_mi.storage.file_access import optional

SUFFIXES = '.txrm', '.xrm'
_TYPES = {5: np.dtype('<u2'), 10: np.dtype('<f4')}  # by the numbers of DataType
_PER_FOLDER = 100  # frames
_FLATS = 'ReferenceData/Image', 'MultiReferenceData/Image'


def open_txrm(path: Path) -> Recording:
    """The frames of a file.

    Raises
    ------
    InputError
        If it is damaged, or its frames are of an unknown type.
    """
    olefile = optional('olefile')
    if not olefile.isOleFile(str(path)):
        raise InputError(f'{path}: is not a {path.suffix} file, or is damaged; copy it again')
    ole = olefile.OleFileIO(str(path))
    n, rows, columns = (
        _integer(path, ole, f'ImageInfo/{name}') for name in ('NoOfImages', 'ImageHeight', 'ImageWidth')
    )
    if not 1 <= n <= MOST_VIEWS or not rows or not columns:
        raise InputError(f'{path}: says {n} frames of {rows} x {columns} pixels, so it is damaged; copy it again')

    def frames(names, kind):
        dtype = _TYPES.get(_integer(path, ole, kind))
        if dtype is None:
            raise InputError(f'{path}: {kind} must be 5 (uint16) or 10 (float32); export the frames as TIFF')

        def read(i):
            return np.frombuffer(_stream(path, ole, names[i], rows * columns * dtype.itemsize), dtype).reshape(
                rows, columns
            )

        return Frames(str(path), len(names), (rows, columns), dtype.newbyteorder('='), read)

    views = frames([f'ImageData{1 + i // _PER_FOLDER}/Image{1 + i}' for i in range(n)], 'ImageInfo/DataType')
    views[0]
    single, several = _FLATS
    flats = [single] if ole.exists(single) else []
    while not ole.exists(single) and ole.exists(f'{several}{len(flats) + 1}'):
        flats.append(f'{several}{len(flats) + 1}')
    kind = ('ReferenceData' if ole.exists(single) else 'MultiReferenceData') + '/DataType'
    return Recording(views, frames(flats, kind) if flats else None, taken=partial(_taken, path, ole, n, rows, columns))


def _taken(path, ole, n, rows, columns):
    """The circle of a Versa, a cone beam, or of an Ultra, whose zone plate makes a parallel one."""
    angles, pixel = _floats(path, ole, 'ImageInfo/Angles', n), _floats(path, ole, 'ImageInfo/PixelSize', 1)[0] / 1000
    scanner: dict[str, Any] = dict(nDetector=[rows, columns], angles=(-angles).tolist())
    if any(entry[0] == 'ConfigZonePlates' for entry in ole.listdir()):
        scanner['mode'] = 'parallel'
    else:
        near, far = (abs(_floats(path, ole, f'ImageInfo/{name}', n)[0]) for name in ('StoRADistance', 'DtoRADistance'))
        if not near > 0:
            raise InputError(f'{path}: ImageInfo/StoRADistance must not be zero; give geometry=FILE')
        scanner |= dict(DSO=float(near), DSD=float(near + far))
        pixel *= (near + far) / near
    scanner['dDetector'] = [float(pixel)] * 2
    # Pixels by which the scanner's software moves each view, right and down, before it puts the axis into the middle.
    shift = np.zeros((n, 2))
    for k, (name, sign) in enumerate((('y', -1), ('x', 1))):
        if ole.exists(f'alignment/{name}-shifts'):
            shift[:, k] = sign * _floats(path, ole, f'alignment/{name}-shifts', n)
    centre = next((name for name in ('AutoRecon/CenterShift', 'ReconSettings/CenterShift') if ole.exists(name)), None)
    if centre is not None:
        shift[:, 1] += _floats(path, ole, centre, 1)[0]
    if np.ptp(shift, axis=0).any():
        scanner['offDetector'] = (shift * pixel).tolist()
    elif shift.any():
        scanner['offDetector'] = (shift[0] * pixel).tolist()
    return Taken(scanner)


def _stream(path, ole, name, size):
    """The first `size` bytes of a stream."""
    if not ole.exists(name):
        raise InputError(
            f'{path}: {name} is missing; export it again, or say where the frames were taken: geometry=FILE'
        )
    data = ole.openstream(name).read(size)
    if len(data) < size:
        raise InputError(f'{path}: {name} is cut off; copy it again')
    return data


def _integer(path, ole, name):
    return int(np.frombuffer(_stream(path, ole, name, 4), '<u4')[0])


def _floats(path, ole, name, count):
    values = np.frombuffer(_stream(path, ole, name, 4 * count), '<f4').astype(float)
    if not np.isfinite(values).all():
        raise InputError(f'{path}: {name} holds no finite numbers; give geometry=FILE')
    return values
