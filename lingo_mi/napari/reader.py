"""The reader of napari: volumes, clouds, projections, and the folder of a result, as layers in mm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.ply import read_ply
from lingo_mi.files.scans import read_scan
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import Geometry
from lingo_mi.storage.output_folder import CLOUD, VOLUME

LayerData = tuple[np.ndarray, dict[str, Any], str]
VOLUMES = '.nii', '.nii.gz', '.ome.zarr'
SCANS = '.npy', '.pickle'


def reader_of(path: str | list[str]) -> Callable[[str | list[str]], list[LayerData]] | None:
    """The function that reads a path, for napari; None for what is neither a volume, a cloud, a scan nor a result.

    Parameters
    ----------
    path : str or list of str
        A file or folder, or several of them.
    """
    return read if all(_kind(Path(each)) for each in _paths(path)) else None


def read(path: str | list[str]) -> list[LayerData]:
    """The layers of a file or a folder: the array, the options and the type of each.

    Volumes are [z, y, x] in mm. Points are (z, y, x) in mm, as large as the Gaussians at one standard deviation on either side.
    Projections are [view, v, u].

    Raises
    ------
    InputError
        If a file is missing or damaged.

    Examples
    --------
    >>> layers = read('out/foot')
    """
    return [layer for each in _paths(path) for layer in _layers(Path(each))]


def volume_layer(volume: np.ndarray, spacing: Any, first: Any, name: str) -> LayerData:
    """An image layer of a volume [x, y, z] whose first voxel's centre lies at `first`, mm."""
    options = dict(name=name, scale=tuple(spacing)[::-1], translate=tuple(first)[::-1], metadata=dict(unit='1/mm'))
    return np.asarray(volume).T, options, 'image'


def scan_layer(projections: np.ndarray, geometry: Geometry, name: str) -> LayerData:
    """An image layer of projections [view, v, u]."""
    angles = np.degrees(geometry.angles).tolist()
    return projections, dict(name=name, scale=(1, *geometry.dDetector), metadata=dict(angles=angles)), 'image'


def _paths(path: str | list[str]) -> list[str]:
    return [path] if isinstance(path, str) else list(path)


def _kind(path: Path) -> str:
    name = path.name.lower()
    if path.is_dir() and ((path / VOLUME).exists() or (path / CLOUD).exists()):
        return 'result'
    for kind, suffixes in dict(volume=VOLUMES, cloud=('.ply',), scan=SCANS).items():
        if name.endswith(suffixes):
            return kind
    return ''


def _layers(path: Path) -> list[LayerData]:
    kind = _kind(path)
    if kind == 'result':
        return [layer for name in (VOLUME, CLOUD) if (path / name).exists() for layer in _layers(path / name)]
    if kind == 'volume':
        volume = read_volume(path)
        return [volume_layer(volume.data, volume.spacing, volume.affine[:3, 3], path.name)]
    if kind == 'cloud':
        return [_cloud(path)]
    if kind == 'scan':
        data = read_scan(path)
        parts = [('', data.train), (' held out', data.test)]
        return [scan_layer(s.projections, s.geometry, path.name + more) for more, s in parts if s is not None]
    raise InputError(f'{path}: is neither a volume, a cloud, a scan nor a result of lingo_mi')


def _cloud(path: Path) -> LayerData:
    centres, scales, _, density = read_ply(path)
    options = dict(
        name=path.name,
        size=2 * scales.mean(1),
        features=dict(density=density),
        face_color='density',
        face_colormap='plasma',
        border_width=0,
        opacity=0.6,
        out_of_slice_display=True,
    )
    return centres[:, ::-1], options, 'points'
