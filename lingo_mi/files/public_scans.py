"""Public measured scans, each as one .npz with its geometry in its authors' terms.

Helsinki Tomography Challenge 2022 (Zenodo 6984868, CC BY 4.0)
    sinogram_<name> [angles, pixels], angles_deg, DSO, DSD, dDetector: a fan beam, which is a cone beam with one row
Walnut (Meaney 2022, Zenodo 6986012, CC BY 4.0)
    projections [view, v, u], row 0 at the top; angles in degrees; DSO, DSD, dDetector; air, the line integral of empty
    air, which is subtracted
"""

from __future__ import annotations

from os import PathLike

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files import arrays
from lingo_mi.files.scanner_dict import make_scan, to_geometry
from lingo_mi.scan import Dataset

_HTC = {'DSO', 'DSD', 'dDetector', 'angles_deg'}
_WALNUT = {'DSO', 'DSD', 'dDetector', 'angles', 'projections', 'air'}


def read_public_scan(path: PathLike | str, name: str = 'ta') -> Dataset:
    """Reads a public scan.

    Parameters
    ----------
    name : str
        Which sinogram of the Helsinki Tomography Challenge.

    Raises
    ------
    InputError
        If the file is damaged, none of those above, or contradicts itself.
    """
    data = arrays.read_npz(path)
    if any(key.startswith('sinogram_') for key in data) and data.keys() >= _HTC:
        return _htc(path, data, name)
    if data.keys() >= _WALNUT:
        return _walnut(path, data)
    raise InputError(
        f'{path}: is not a scan of the Helsinki Tomography Challenge (sinogram_<name>, {", ".join(sorted(_HTC))}), nor the '
        f'walnut ({", ".join(sorted(_WALNUT))}), the only .npz scans that can be read; give .npy with a .yml beside it'
    )


def _htc(path, data, name):
    names = sorted(key[len('sinogram_') :] for key in data if key.startswith('sinogram_'))
    if name not in names:
        raise InputError(f'{path}: has no sinogram {shown(name)}; it has {", ".join(names)}')
    sinogram = arrays.numeric(data[f'sinogram_{name}'], f'{path}: sinogram_{name}', 2)
    degrees = arrays.numeric(data['angles_deg'], f'{path}: angles_deg', 1).astype(float)
    if len(degrees) != len(sinogram):
        raise InputError(
            f'{path}: has {len(degrees)} angles for {len(sinogram)} rows of the sinogram; these must agree'
        )
    if len(degrees) and np.isclose(degrees[-1] - degrees[0], 360):
        degrees, sinogram = degrees[:-1], sinogram[:-1]
    # Their source is at DSO (sin a, -cos a, 0) and their columns run along (cos a, sin a): ours at a - 90 degrees. The row is
    # as high as a pixel is wide; the slice is one voxel of the challenge's reference reconstructions.
    numbers = {k: data[k] for k in ('DSO', 'DSD', 'dDetector')} | dict(nVoxel=(512, 512, 1), dVoxel=0.1483)
    geometry = to_geometry(numbers | dict(nDetector=(1, sinogram.shape[1])), np.radians(degrees - 90), path)
    return Dataset(make_scan(geometry, sinogram[:, None, :], path))


def _walnut(path, data):
    projections = arrays.numeric(data['projections'], f'{path}: projections', 3)
    degrees = arrays.numeric(data['angles'], f'{path}: angles', 1).astype(float)
    air = np.ravel(arrays.numeric(data['air'], f'{path}: air', None)).astype(np.float32)
    if len(degrees) != len(projections):
        raise InputError(f'{path}: has {len(degrees)} angles for {len(projections)} views; these must agree')
    if len(air) != 1:
        raise InputError(f'{path}: air must be one number, not {len(air)}')
    # Their source is at DSO (-sin a, cos a, 0), ours at a + 90 degrees, and their columns run along (cos a, sin a), ours the
    # other way.
    numbers = {k: data[k] for k in ('DSO', 'DSD', 'dDetector')} | dict(nVoxel=(128,) * 3, dVoxel=0.305)
    geometry = to_geometry(numbers | dict(nDetector=projections.shape[1:]), np.radians(degrees + 90), path)
    return Dataset(make_scan(geometry, projections[:, :, ::-1].astype(np.float32) - air, path))
