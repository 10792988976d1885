"""The readers by name, what each is given, and what its value must be."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from studies.fuzz import corpus, mutations
from studies.fuzz.corpus import Sample

# Shapes and types of raw bytes, which the command line gives.
SHAPES = [
    (4, 5, 6),
    (6, 5, 4),
    (4, 5),
    (0, 5, 6),
    (-4, -5, 6),
    (10**9,) * 3,
    (10**400, 1, 1),
    ('a', 1, 1),
    (4.5, 5, 6),
    None,
]
DTYPES = [
    'uint8',
    '<u1',
    'f4',
    ',',
    '',
    'i4,i4',
    '(2,3)u1',
    'O',
    'V8',
    'U99999',
    'c8',
    'M8',
    '9' * 400,
    'f4' * 99,
    '{',
    None,
]


def _volume(path: Path, rng: Random) -> None:
    from lingo_mi.files.volumes import read_volume

    options = dict(shape=rng.choice(SHAPES), dtype=rng.choice(DTYPES)) if path.suffix == '.raw' else {}
    volume = read_volume(path, **options)
    _finite(volume.data, 3, np.float32)
    _finite(volume.affine, 2)


def _scan(path: Path, rng: Random) -> None:
    from lingo_mi.files.scans import read_scan

    dataset = read_scan(path)
    for scan in (dataset.train, dataset.test):
        if scan is not None:
            _finite(scan.projections, 3, np.float32)
            _rays(scan.geometry.rays())
            _rays(scan.geometry.normalised_rays())
    if dataset.volume is not None:
        _finite(dataset.volume, 3, np.float32)


def _poses(path: Path, rng: Random) -> None:
    from lingo_mi.files.poses import read_poses

    _rays(read_poses(path, (4, 5), (2.0, 3.0), parallel=rng.random() < 0.2))


def _ply(path: Path, rng: Random) -> None:
    from lingo_mi.files.ply import read_ply

    for array, dimensions in zip(read_ply(path), (2, 2, 2, 1)):
        _finite(array, dimensions, np.float32)


def _exr(path: Path, rng: Random) -> None:
    from lingo_mi.files.images import read_exr

    _finite(read_exr(path), 2, np.float32)


def _checkpoint(path: Path, rng: Random) -> None:
    from lingo_mi.fitting.checkpoint import Checkpoint

    stored = Checkpoint.load(path)
    for values in stored.state.values.values():
        _finite(values, 2, np.float32)


def _scene(path: Path, rng: Random) -> None:
    from lingo_mi.common.runtime import ensure_variant
    from lingo_mi.scene.load import load_scene

    ensure_variant()
    load_scene(path)


def _finite(array: Any, dimensions: int, dtype: Any = np.float64) -> None:
    if array.ndim != dimensions or array.dtype != dtype or not array.size or not np.isfinite(array).all():
        raise AssertionError(
            f'no finite {np.dtype(dtype)} array of {dimensions} dimensions: {array.dtype}{array.shape}'
        )


def _rays(rays: Any) -> None:
    for array in (rays.source, rays.corner, rays.u, rays.v):
        _finite(array, 2)


@cache
def samples() -> dict[str, tuple[Callable[[Path, Random], None], list[Sample]]]:
    """Every reader but the scenes': its function and its good files, by name."""
    groups = ((_volume, corpus.volumes()), (_scan, corpus.scans()))
    out = {name: (read, files) for read, group in groups for name, files in group.items()}
    reads = dict(ply=_ply, exr=_exr, poses=_poses, checkpoint=_checkpoint)
    return out | {name: (reads[name], files) for name, files in corpus.others().items()}


@cache
def scenes() -> dict[str, tuple[Callable[[Path, Random], None], list[Sample]]]:
    """The scenes' reader, which loads Mitsuba."""
    return {'scene': (_scene, corpus.scenes()['scene'])}


NAMES = (
    'npy', 'npz', 'nii', 'nii.gz', 'hdr, img', 'nrrd', 'mha, mhd', 'raw', 'ome-zarr', 'tiff', 'dicom', 'naf', 'r2', 'npy, yml',
    'zarr, yml', 'hdf5, yml', 'public scans', 'exr folder', 'ply', 'exr', 'poses', 'checkpoint', 'scene',
)  # fmt: skip


def reader(name: str) -> tuple[Callable[[Path, Random], None], list[Sample]]:
    """A reader's function and its good files."""
    return (scenes() if name == 'scene' else samples())[name]


def case(name: str, rng: Random) -> tuple[int, str, bytes]:
    """Choose a sample of a reader and one of its files, and mutate the file."""
    sample = reader(name)[1]
    index = rng.randrange(len(sample))
    files = sample[index].files
    # The first file is what says where the others are.
    file = rng.choice([next(iter(files)), *files])
    return index, file, mutations.mutated(files[file], file, rng)


def write(sample: Sample, folder: Path) -> None:
    """The good files of a sample, below `folder`."""
    for name, content in sample.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.content())
