"""OME-Zarr: the finest level of the first image in a folder .ome.zarr. OME-NGFF 0.4 and 0.5, Zarr 2 and 3.

https://ngff.openmicroscopy.org/specifications/0.5/ zarr unpacks the values. The metadata are read here: ome-zarr compares
no shape with the memory, and neither library refuses by its name a codec that runs code.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, brief, shown
from lingo_mi.common.memory import require_room
from lingo_mi.storage.file_access import optional, read_json, reading

# Codecs that pack numbers. Others, such as pickle, can run a stranger's code.
CODECS = {'bytes', 'transpose', 'sharding_indexed', 'crc32c', 'gzip', 'zlib', 'bz2', 'lzma', 'lz4', 'zstd', 'blosc'}
MILLIMETRES = {'millimeter': 1.0, 'micrometer': 1e-3, 'nanometer': 1e-6, 'centimeter': 10.0, 'meter': 1e3, None: 1.0}
SPACE = 'x', 'y', 'z'


def read_ome_zarr(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """The values [x, y, z], the affine [4, 4] in mm, and a description if the file is ours, else ''.

    Raises
    ------
    InputError
        If the folder is damaged, another one, or has several values a voxel; and if zarr is missing.
    """
    zarr = optional('zarr', 'ome-zarr')

    def fail(what):
        raise InputError(f'{path}: {what}')

    with reading(path, folder=True):
        attributes = _attributes(path)
    metadata = attributes.get('ome', attributes)
    try:
        image = metadata['multiscales'][0]
        axes, level = image['axes'], image['datasets'][0]
        names = [str(axis['name']) for axis in axes]
        folder = path / _below(str(level['path']))
        everywhere = image.get('coordinateTransformations') or []  # after the transformations of a level
        scale, shift = _placed([*level['coordinateTransformations'], *everywhere], len(names))
        units = [MILLIMETRES[axis.get('unit')] for axis in axes if axis['name'] in SPACE]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError):
        fail('has no image in the form of OME-Zarr 0.4 or 0.5, or a unit of length unknown here; correct its metadata')
    if not set(SPACE) <= set(names) or len(set(names)) != len(names):
        fail(f'has the axes {" ".join(names)}; a volume with the axes z, y and x is needed')
    with reading(folder, folder=True):
        version = require_codecs(path, folder)
        try:
            array: Any = zarr.open_array(str(folder), mode='r', zarr_format=version)
            shape, dtype = tuple(int(n) for n in array.shape), np.dtype(array.dtype)
        except Exception as error:  # zarr raises many kinds
            fail(f'is damaged ({brief(error, 100)}); fetch it again')
        if len(shape) != len(names) or dtype.kind not in 'buif':
            fail(f'has values of the type {dtype} in the shape {list(shape)}, not one number a voxel')
        if any(n != 1 for n, name in zip(shape, names) if name not in SPACE) or min(shape) < 1:
            fail(f'has the shape {list(shape)} along {" ".join(names)}; a single volume is needed')
        # A piece is unpacked whole, even if it is larger than the array.
        together = math.prod(map(max, shape, _piece(array)))
        require_room(together * (dtype.itemsize + 8), path)
        try:
            values = np.asarray(array[...])
        except Exception as error:  # codecs raise many kinds
            fail(f'is damaged: its data cannot be unpacked ({brief(error, 100)}); fetch it again')
    spatial = [i for i, name in enumerate(names) if name in SPACE]
    values = values.reshape([shape[i] for i in spatial])
    order = [[names[i] for i in spatial].index(name) for name in SPACE]
    affine = np.eye(4)
    affine[:3, :3] = np.diag((scale[spatial] * units)[order])
    affine[:3, 3] = (shift[spatial] * units)[order]
    ours = attributes.get('lingo_mi')
    return values.transpose(order), affine, f'lingo_mi: {ours}' if isinstance(ours, str) else ''


def _piece(array):
    """The shape of what lies in one file: a shard, or a chunk."""
    return [int(n) for n in getattr(array, 'shards', None) or array.chunks]


def _attributes(path):
    """The group's own attributes, of Zarr 3 or 2."""
    for name, key in (('zarr.json', 'attributes'), ('.zattrs', None)):
        if (path / name).is_file():
            attributes = _json(path, path / name)
            attributes = attributes.get(key) if key else attributes
            if isinstance(attributes, dict):
                return attributes
    raise InputError(f'{path}: is not a Zarr group; give the folder that holds zarr.json or .zattrs')


def _json(path, file):
    content = read_json(file)
    if not isinstance(content, dict):
        raise InputError(f'{path}: {file.name} is damaged; fetch it again')
    return content


def _below(name):
    """A path that stays in its folder."""
    parts = Path(name).parts
    if not parts or Path(name).is_absolute() or '..' in parts:
        raise ValueError(name)
    return Path(*parts)


def _placed(transformations, dimensions):
    """Steps, and the centre of the first voxel."""
    steps, shift = np.ones(dimensions), np.zeros(dimensions)
    for transformation in transformations:
        kind = transformation['type']
        if kind == 'identity':
            continue
        numbers = np.array([float(n) for n in transformation[kind]])
        if kind not in ('scale', 'translation') or len(numbers) != dimensions or not np.isfinite(numbers).all():
            raise ValueError(kind)
        if kind == 'scale':
            steps, shift = steps * numbers, shift * numbers
        else:
            shift = shift + numbers
    return steps, shift


def require_codecs(path: Path, folder: Path) -> int:
    """The version of Zarr of the array in `folder`.

    Raises
    ------
    InputError
        In the name of `path`, for a codec that is not of CODECS.
    """
    if (folder / 'zarr.json').is_file():
        version, used = 3, _names(_json(path, folder / 'zarr.json').get('codecs'))
    elif (folder / '.zarray').is_file():
        header = _json(path, folder / '.zarray')
        version, used = 2, [*_names([header.get('compressor')]), *_names(header.get('filters'))]
    else:
        raise InputError(f'{path}: has no array in {folder.name}; fetch it again')
    for name in used:
        if not isinstance(name, str) or name not in CODECS:
            raise InputError(
                f'{path}: is packed with {shown(name)}, which is not read here; write it with zstd or blosc'
            )
    return version


def _names(codecs):
    """Return the names of codecs, and of the codecs inside them, as the metadata state them."""
    for codec in codecs if isinstance(codecs, list) else [codecs]:
        if not isinstance(codec, dict):
            yield from [] if codec is None else [codec]
            continue
        yield from [codec[key] for key in ('name', 'id') if key in codec] or [codec]  # of Zarr 3 and 2
        inside = codec.get('configuration')
        if isinstance(inside, dict):
            yield from _names(inside.get('codecs'))
            yield from _names(inside.get('index_codecs'))
