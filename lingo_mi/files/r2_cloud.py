r"""Clouds of R2-Gaussian: where its training starts (`init_NAME.npy`) and what it makes (`point_cloud.pickle`).

- `.npy` [N, 4]: x, y, z and density. The training starts with isotropic Gaussians, as wide as the root mean square distance to
  their three nearest neighbours.
- `.pickle`: a dictionary of float32 `xyz` [N, 3], `density` [N, 1], `scale` [N, 3], `rotation` [N, 4], and `scale_bound`, two
  numbers or None. They are stored before their activations: softplus for the density; for scales the exponential, or between
  the bounds the logistic function. Quaternions have the real part first, (w, x, y, z), and any length.

Its world is this package's, but the longest side of the volume is 2 long, :math:`k = 2 / \max s_{voxel}` of a mm. Densities are
the same in both. Facts: github.com/Ruyi-Zha/r2_gaussian; Zha et al., NeurIPS 2024.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from scipy.special import expit

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.neighbours import neighbour_distance
from lingo_mi.files import arrays
from lingo_mi.files.naf import load_pickle, write_pickle
from lingo_mi.files.ply import check_cloud
from lingo_mi.geometry.grid import Grid

NEAREST = 1e-3  # least distance of neighbours, in R2-Gaussian's world
LEAST = 1e-12  # density whose inverse softplus is finite
_COLUMNS = {'xyz': 3, 'scale': 3, 'rotation': 4, 'density': 1}
_Cloud = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def read_r2_cloud(path: PathLike | str, grid: Grid) -> _Cloud:
    """Reads a cloud: (centres [N, 3] mm, scales [N, 3] mm, quaternions [N, 4] (x, y, z, w), density [N]), float32.

    Parameters
    ----------
    grid : Grid
        The voxels of the scan that it belongs to: they say how long a mm is.

    Raises
    ------
    InputError
        If the file is neither .npy nor .pickle, is damaged, or holds no cloud.
    """
    path = Path(path)
    mm = max(grid.size) / 2
    if path.suffix == '.npy':
        table = np.asarray(arrays.read_npy(path, 2), float)
        if table.shape[1] != 4 or not len(table):
            raise InputError(f'{path}: must have the shape [N, 4], x, y, z and density, not {table.shape}')
        width = np.maximum(neighbour_distance(table[:, :3], NEAREST), NEAREST)
        turned = np.tile([0.0, 0.0, 0.0, 1.0], (len(table), 1))
        cloud = mm * table[:, :3], mm * np.repeat(width[:, None], 3, 1), turned, table[:, 3]
    elif path.suffix == '.pickle':
        cloud = _activated(path, load_pickle(path), mm)
    else:
        raise InputError(f'{path}: is not a cloud of R2-Gaussian; give its init_*.npy or point_cloud.pickle')
    centres, scales, quaternions, density = (np.asarray(values, np.float32) for values in cloud)
    check_cloud(path, centres, scales, quaternions, density)
    return centres, scales, quaternions, density


def _activated(path, data, mm):
    values = {}
    for name, columns in _COLUMNS.items():
        value = data.get(name) if isinstance(data, dict) else None
        array = np.asarray(value, float) if isinstance(value, np.ndarray) and value.dtype.kind == 'f' else np.empty(0)
        if array.shape != (len(array), columns):
            raise InputError(f"{path}: has no '{name}' [N, {columns}]; give the point_cloud.pickle of R2-Gaussian")
        values[name] = array
    bound = data.get('scale_bound')
    if bound is None:
        with np.errstate(over='ignore'):
            scale = np.exp(values['scale'])
    else:
        try:
            low, high = (float(number) for number in bound)
        except (TypeError, ValueError):
            raise InputError(f'{path}: scale_bound must be two numbers or None, not {shown(bound)}') from None
        scale = low + (high - low) * expit(values['scale'])
    density = np.logaddexp(0, values['density'][:, 0])
    return mm * values['xyz'], mm * scale, values['rotation'][:, [1, 2, 3, 0]], density


def write_r2_cloud(
    path: PathLike | str,
    grid: Grid,
    centres: np.ndarray,
    scales: np.ndarray,
    quaternions: np.ndarray,
    density: np.ndarray,
) -> None:
    """Writes a cloud, arrays as for `read_r2_cloud`, whole or not at all: .npy without scales and quaternions, or .pickle.

    Raises
    ------
    InputError
        For another suffix, for arrays that are not a cloud, for negative densities, and for a file that cannot be written.
    """
    path = Path(path)
    centres, scales, quaternions, density = (np.asarray(a, float) for a in (centres, scales, quaternions, density))
    check_cloud(path, centres, scales, quaternions, density)
    if density.min() < 0:
        raise InputError(f'{path}: R2-Gaussian has no negative densities, but Gaussian {density.argmin()} has one')
    k = 2 / max(grid.size)
    if path.suffix == '.npy':
        arrays.write_npy(path, np.concatenate([k * centres, density[:, None]], 1))
    elif path.suffix == '.pickle':
        rho = np.maximum(density, LEAST)[:, None]
        stored = dict(
            xyz=k * centres,
            density=rho + np.log(-np.expm1(-rho)),
            scale=np.log(k * scales),
            rotation=quaternions[:, [3, 0, 1, 2]],
        )
        write_pickle(path, {**{name: a.astype(np.float32) for name, a in stored.items()}, 'scale_bound': None})
    else:
        raise InputError(f'{path}: clouds of R2-Gaussian are .npy (where its training starts) or .pickle')
