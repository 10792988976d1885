"""NIfTI-1 and -2, .nii, .nii.gz and .hdr with .img, and Analyze: header and voxels.

nibabel makes sense of the header's block and of the voxels, whose claims are checked in between. `nibabel.load` would unpack an
extension of a gigabyte from a file of megabytes, reach no checksum, and read the .mat file beside an Analyze header.
"""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.voxels import MOST_DEFLATED, require_claim, require_end
from lingo_mi.storage.file_access import one_line, quiet, reading

_TO_MM = {'meter': 1000.0, 'micron': 1e-3}  # mm, also if the file gives no unit
_LONGEST_HEADER = 540


def read_nifti(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """The values [x, y, z] with the header's slope, the affine [4, 4] in mm, and the description.

    Raises
    ------
    InputError
        If a file is missing, damaged or another one.
    """
    from nibabel.arrayproxy import ArrayProxy

    voxels = path
    pair = path.suffix.lower() in ('.hdr', '.img')
    if pair:
        upper = path.suffix.isupper()
        path, voxels = (path.with_suffix(s.upper() if upper else s) for s in ('.hdr', '.img'))
    packed = path.name.lower().endswith('.gz')
    unpack: Any = gzip.open if packed else open
    try:
        with reading(path), quiet('nibabel.global'), unpack(path, 'rb') as stream:
            header = _header(stream.read(_LONGEST_HEADER), pair)
        affine, description = np.array(header.get_best_affine(), float), ''
        if 'xyzt_units' in header:
            affine[:3] *= _TO_MM.get(str(header.get_xyzt_units()[0]), 1.0)
            description = bytes(header['descrip'].item()).decode('utf-8', 'replace')
        with reading(voxels), unpack(voxels, 'rb') as stream, np.errstate(over='ignore', invalid='ignore'):
            proxy: Any = ArrayProxy(stream, header)
            require_claim(voxels, proxy.shape, proxy.dtype, MOST_DEFLATED if packed else 1, proxy.offset)
            data = np.asanyarray(proxy)
            if packed:
                require_end(stream, voxels)
    except InputError:
        raise
    except Exception as error:  # a damaged file fails inside nibabel in many ways
        raise InputError(f'{path}: is damaged or not a NIfTI file ({one_line(error)}); fetch it again') from None
    while data.ndim > 3 and data.shape[-1] == 1:
        data = data[..., 0]
    return data, affine, description


def _header(block: bytes, pair: bool) -> Any:
    from nibabel.nifti1 import Nifti1Header, Nifti1PairHeader
    from nibabel.nifti2 import Nifti2Header, Nifti2PairHeader
    from nibabel.spm2analyze import Spm2AnalyzeHeader

    if int.from_bytes(block[:4], 'little') == 540 or int.from_bytes(block[:4], 'big') == 540:
        return (Nifti2PairHeader if pair else Nifti2Header)(block)
    if block[344:348] in (b'n+1\0', b'ni1\0') or not pair:
        return (Nifti1PairHeader if pair else Nifti1Header)(block[:348])
    return Spm2AnalyzeHeader(block[:348])
