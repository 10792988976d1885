"""NIfTI-1 and -2, .nii, .nii.gz and .hdr with .img, and Analyze: header and voxels.

nibabel makes sense of the header's fixed block. Extensions, and the .mat file beside an Analyze header, are not read.
"""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.voxels import MOST_DEFLATED, read_exactly, require_claim
from lingo_mi.storage.file_access import one_line, quiet, reading

_TO_MM = {'meter': 1000.0, 'micron': 1e-3}  # mm, and where no unit is told
_LONGEST_HEADER = 540


def read(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """The values [x, y, z] with the header's slope, the affine [4, 4] in mm, and the description.

    Raises InputError where a file is missing, damaged or another one.
    """
    voxels = path
    pair = path.suffix.lower() in ('.hdr', '.img')
    if pair:
        upper = path.suffix.isupper()
        path, voxels = (path.with_suffix(s.upper() if upper else s) for s in ('.hdr', '.img'))
    packed = path.name.lower().endswith('.gz')
    with reading(path):
        try:
            with quiet('nibabel.global'), gzip.open(path) if packed else open(path, 'rb') as stream:
                header = _header(stream.read(_LONGEST_HEADER), pair)
            shape = tuple(int(n) for n in header.get_data_shape())
            dtype, start = header.get_data_dtype(), int(header.get_data_offset())
            slope, offset = header.get_slope_inter()
            affine, description = np.array(header.get_best_affine(), float), ''
            if 'xyzt_units' in header:
                to_mm = _TO_MM.get(str(header.get_xyzt_units()[0]), 1.0)
                affine[:3] *= to_mm
                description = bytes(header['descrip'].item()).decode('utf-8', 'replace')
        except OSError as error:
            if error.errno is not None:
                raise
            raise _damaged(path, error) from None
        except InputError:
            raise
        except Exception as error:  # a damaged header fails inside nibabel in many ways
            raise _damaged(path, error) from None
    with reading(voxels):
        size = require_claim(voxels, shape, dtype, MOST_DEFLATED if packed else 1, start)
        if packed:
            try:
                with gzip.open(voxels) as stream:
                    data = np.frombuffer(read_exactly(stream, voxels, start, size, finish=True), dtype)
            except (EOFError, zlib.error) as error:
                raise _damaged(path, error) from None
            data = data.reshape(shape, order='F')
        else:
            data: Any = np.memmap(voxels, dtype, 'c', start, shape, 'F')
    while data.ndim > 3 and data.shape[-1] == 1:
        data = data[..., 0]
    return _scaled(data, slope, offset, path), affine, description


def _damaged(path, error):
    return InputError(f'{path}: is damaged or not a NIfTI file ({one_line(error)}); fetch it again')


def _header(block: bytes, pair: bool) -> Any:
    from nibabel.nifti1 import Nifti1Header, Nifti1PairHeader
    from nibabel.nifti2 import Nifti2Header, Nifti2PairHeader
    from nibabel.spm2analyze import Spm2AnalyzeHeader

    if int.from_bytes(block[:4], 'little') == 540 or int.from_bytes(block[:4], 'big') == 540:
        return (Nifti2PairHeader if pair else Nifti2Header)(block)
    if block[344:348] in (b'n+1\0', b'ni1\0') or not pair:
        return (Nifti1PairHeader if pair else Nifti1Header)(block[:348])
    return Spm2AnalyzeHeader(block[:348])


def _scaled(data, slope, offset, path):
    from nibabel.volumeutils import apply_read_scaling

    try:
        with np.errstate(over='ignore', invalid='ignore'):
            return apply_read_scaling(
                data, np.float64(1 if slope is None else slope), np.float64(0 if offset is None else offset)
            )
    except Exception as error:  # of structures, such as colours
        raise _damaged(path, error) from None
