"""The objects of the paper's tables: phantoms, volumes in the folder that LINGO_MI_DATA names, and scans of X3D's kind."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from skimage.transform import resize_local_mean

from lingo_mi import phantoms
from lingo_mi.common.errors import InputError
from lingo_mi.files.r2 import META
from lingo_mi.files.volumes import read_volume
from lingo_mi.storage.output_folder import digest

PHANTOMS = 'foot', 'chest', 'shepp_logan'
VOLUMES = ('aneurism', 'engine', 'teapot', 'tooth', 'chest_lidc0314', 'abdomen_ts', 'aorta_ts', 'head_fsrt', 'jaw_fsrt')


def available(names: Iterable[str], say: Callable[[str], object]) -> list[str]:
    """Return the objects that exist: phantoms, and volumes NAME.nii.gz in the folder that LINGO_MI_DATA names.

    Parameters
    ----------
    say : callable
        Called with a line for each of VOLUMES that is missing.

    Raises
    ------
    InputError
        For a name that is neither, and if no object is left.
    """
    objects = []
    for name in names:
        if name in PHANTOMS or (path := _file(name)) is not None and path.is_file():
            objects.append(name)
        elif name in VOLUMES:
            say(f'{name}: skipped, since there is no {name}.nii.gz in the folder that LINGO_MI_DATA names')
        else:
            raise InputError(
                f'object {name!r} is unknown: use {", ".join((*PHANTOMS, *VOLUMES))}, or a volume NAME.nii.gz '
                'in the folder that LINGO_MI_DATA names'
            )
    if not objects:
        raise InputError(
            f'no object is left: let LINGO_MI_DATA name the folder of the volumes, or use {" or ".join(PHANTOMS)}'
        )
    return objects


def scans_in(folder: Path) -> dict[str, Path]:
    """The scans of X3D's kind in a folder, by name: pickles NAME_50.pickle of SAX-NeRF and NAF, and folders of R2-Gaussian.

    Raises
    ------
    InputError
        If there is none.
    """
    if not folder.is_dir():
        raise InputError(f'{folder}: is not a folder; give the folder with the scans')
    pickles = {path.stem.removesuffix('_50'): path for path in folder.iterdir() if path.suffix in ('.pickle', '.pkl')}
    folders = {path.name: path for path in folder.iterdir() if (path / META).is_file()}
    scans = dict(sorted((pickles | folders).items()))
    if not scans:
        raise InputError(f'{folder}: holds neither pickles of SAX-NeRF or NAF nor folders of R2-Gaussian')
    return scans


@functools.cache
def scan_digest(path: Path) -> str:
    """A digest of a scan's content; of a folder, of its geometry file and of the names and sizes of all others."""
    if path.is_file():
        return digest(path)
    others = [(str(f.relative_to(path)), f.stat().st_size) for f in sorted(path.rglob('*')) if f.is_file()]
    return f'{digest(path / META)} {others}'


def _file(name: str) -> Path | None:
    folder = os.environ.get('LINGO_MI_DATA')
    return Path(folder) / f'{name}.nii.gz' if folder else None


def load_object(name: str, size: int) -> phantoms.Phantom:
    """An object on at most `size` voxels along its longest side, averaged over the voxels that each of these covers.

    Raises
    ------
    InputError
        If its file cannot be read.
    """
    if name in PHANTOMS:
        return replace(phantoms.make(name, size), analytic=None)  # like the volumes, projected as voxels
    path = _file(name)
    if path is None:
        raise InputError(f'object {name!r}: let LINGO_MI_DATA name the folder of {name}.nii.gz')
    volume = read_volume(path)
    return averaged(phantoms.Phantom(volume.data, volume.spacing, name), size)


def averaged(phantom: phantoms.Phantom, size: int) -> phantoms.Phantom:
    """An object on at most `size` voxels along its longest side, averaged over the voxels that each of these covers."""
    shape = phantom.data.shape
    if max(shape) <= size:
        return phantom
    smaller = tuple(max(round(n * size / max(shape)), 1) for n in shape)
    spacing = tuple(d * n / m for d, n, m in zip(phantom.spacing, shape, smaller))
    return phantoms.Phantom(resize_local_mean(phantom.data, smaller).astype(np.float32), spacing, phantom.name)
