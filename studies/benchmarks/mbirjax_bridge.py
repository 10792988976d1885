"""MBIRJAX on scans of this package. Needs the extra `reference`; every function takes its module.

MBIRJAX numbers voxels [row, column, slice]. With rows along our x and columns along our y, its view angles and detector channels
are ours; its slices run down, like detector rows, and ours up.

    import mbirjax
    volume = reconstruct(scan, mbirjax)

Bouman and Buzzard et al., https://mbirjax.readthedocs.io
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.scan import Scan
from studies.benchmarks.rtk_bridge import require_every_pixel


def model(geometry: Geometry, mbirjax: Any) -> Any:
    """MBIRJAX's model of a scan.

    Raises
    ------
    InputError
        For one that is not on a circle, or whose voxels are not cubes on the axis.
    """
    if not isinstance(geometry, CircularGeometry) or geometry.mode != 'cone':
        raise InputError('MBIRJAX is compared with on circles of a cone beam only')
    if len(set(geometry.grid.spacing)) > 1 or any(geometry.grid.centre[:2]):
        raise InputError('MBIRJAX is compared with on cubic voxels around the axis of rotation only')
    out = mbirjax.ConeBeamModel(
        (len(geometry), *geometry.nDetector), np.asarray(geometry.angles, float), geometry.DSD, geometry.DSO
    )
    (dv, du), (up, along) = geometry.dDetector, geometry.offDetector
    out.set_params(
        delta_det_row=float(dv), delta_det_channel=float(du), det_row_offset=float(up), det_channel_offset=-float(along),
        delta_voxel=float(geometry.grid.spacing[0]), recon_shape=tuple(geometry.grid.shape),
        recon_slice_offset=-float(geometry.grid.centre[2]), verbose=0,
    )  # fmt: skip
    return out


def project(volume: np.ndarray, geometry: Geometry, mbirjax: Any) -> np.ndarray:
    """Projections [view, v, u] of a volume [x, y, z]."""
    return np.asarray(model(geometry, mbirjax).forward_project(np.ascontiguousarray(volume[:, :, ::-1], np.float32)))


def reconstruct(scan: Scan, mbirjax: Any, **settings: Any) -> np.ndarray:
    """Volume [x, y, z] by MBIRJAX's reconstruction with its prior of neighbouring voxels (qGGMRF).

    Parameters
    ----------
    settings
        Settings of its model, such as sharpness=1.0.
    """
    require_every_pixel(scan, 'MBIRJAX')
    ct_model = model(scan.geometry, mbirjax)
    ct_model.set_params(**settings)
    volume, _ = ct_model.recon(np.ascontiguousarray(scan.projections, np.float32), print_logs=False, logfile_path=None)
    return np.asarray(volume)[:, :, ::-1].copy()
