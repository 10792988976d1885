"""Clouds of 3D Gaussians in PLY files that Mitsuba's `ellipsoids` shape and 3DGS viewers both read.

Binary little endian, all properties float32, in the order that Mitsuba's `ellipsoids` plugin demands:

    x y z  nx ny nz  f_dc_0..2  opacity  density  scale_0..2  rot_0..3

scale is stored as its logarithm, rot with the real part first. `density` is this project's own; Mitsuba makes
it the attribute `density`. The plugin treats a file as a 3DGS cloud, and would misread `density`, only if
`opacity` directly precedes `scale_0`. Here `density` does, so f_dc and opacity become plain attributes. They are
for viewers only: mid-grey, and the logit of the opacity of a ray through the centre, 1 - exp(-density sqrt(2
pi) s), with s the geometric mean of the scales. `read_ply` ignores them.

Clouds fitted by alpha compositing have no density: `write_radiance_ply` writes exactly the columns of 3DGS.
"""

from __future__ import annotations

import os
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import require_room
from lingo_mi.storage.file_access import reading, replacing

_CENTRE = 'x', 'y', 'z'
_SCALE = 'scale_0', 'scale_1', 'scale_2'
_ROT = 'rot_0', 'rot_1', 'rot_2', 'rot_3'
_LONGEST_LINE, _LONGEST_HEADER = 4096, 1 << 20
_REST = 15  # coefficients of the harmonics of degrees 1 to 3, of each of three colours
_PROPERTIES = (*_CENTRE, 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'density', *_SCALE, *_ROT)
_TYPES = {
    'char': 'i1',
    'int8': 'i1',
    'uchar': 'u1',
    'uint8': 'u1',
    'short': '<i2',
    'int16': '<i2',
    'ushort': '<u2',
    'uint16': '<u2',
    'int': '<i4',
    'int32': '<i4',
    'uint': '<u4',
    'uint32': '<u4',
    'float': '<f4',
    'float32': '<f4',
    'double': '<f8',
    'float64': '<f8',
}


def check_cloud(
    where: PathLike | str,
    centres: np.ndarray,
    scales: np.ndarray,
    quaternions: np.ndarray,
    density: np.ndarray,
    name: str = 'density',
) -> None:
    """Raises InputError unless these are N Gaussians, as for `write_ply`. name: what the message calls the density."""
    n = len(density)
    if n == 0:
        raise InputError(f'{where}: the cloud is empty; at least one Gaussian is needed')
    for what, array, shape in (
        ('centres', centres, (n, 3)),
        ('scales', scales, (n, 3)),
        ('quaternions', quaternions, (n, 4)),
        (name, density, (n,)),
    ):
        if array.shape != shape:
            raise InputError(f'{where}: {what} must have the shape {shape}, not {array.shape}')
        if not np.isfinite(array).all():
            bad = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise InputError(f'{where}: {what} of Gaussian {bad} is not finite; remove that Gaussian')
    if not (scales > 0).all():
        raise InputError(f'{where}: the scale of Gaussian {int(np.argwhere(scales <= 0)[0, 0])} is not positive')
    norm = np.linalg.norm(quaternions, axis=1)
    if not (norm > 0).all():
        raise InputError(
            f'{where}: the quaternion of Gaussian {int(np.argmin(norm))} is zero; it must have a direction'
        )


def write_ply(
    path: PathLike | str,
    centres: ArrayLike,
    scales: ArrayLike,
    quaternions: np.ndarray,
    density: ArrayLike,
    second: ArrayLike | None = None,
) -> None:
    """Writes a cloud, whole or not at all.

    centres [N, 3] and scales [N, 3] (standard deviations, > 0) in one unit of length, quaternions [N, 4] (x, y, z, w; normalised
    here), density [N] at the centres; second [N], if given, is a further property of that name, a second material's share in the
    density.

    Raises
    ------
    InputError
        For wrong shapes, values that are not finite, scales that are not positive, zero quaternions, an empty cloud, or a file
        that cannot be written.
    """
    centres, scales, quaternions, density = (np.asarray(a, float) for a in (centres, scales, quaternions, density))
    density = density.reshape(-1) if density.shape[1:] == (1,) else density
    if density.ndim != 1:
        raise InputError(f'{path}: density must have one dimension, not the shape {density.shape}')
    check_cloud(path, centres, scales, quaternions, density)
    quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    depth = np.maximum(density, 0) * np.sqrt(2 * np.pi) * np.exp(np.log(scales).mean(1))
    # logit(1 - exp(-t)) = log(exp(t) - 1), limited to where viewers' sigmoid does not saturate
    opacity = np.log(np.expm1(np.clip(depth, 1e-4, 10)))
    zeros = np.zeros((len(density), 6))
    more = [] if second is None else [np.asarray(second, float)[:, None]]
    table = np.concatenate(
        [centres, zeros, opacity[:, None], *more, density[:, None], np.log(scales), quaternions[:, [3, 0, 1, 2]]], 1
    )
    names = [p for name in _PROPERTIES for p in (['second'] if more and name == 'density' else []) + [name]]
    _write(path, names, table)


def write_radiance_ply(
    path: PathLike | str,
    centres: ArrayLike,
    scales: ArrayLike,
    quaternions: np.ndarray,
    opacity: ArrayLike,
    radiance: ArrayLike,
    harmonics: ArrayLike,
) -> None:
    """Writes a grey cloud as 3DGS does, for its viewers, whole or not at all.

    centres, scales, quaternions as for `write_ply`; opacity [N] in [0, 1]; radiance [N] and harmonics [N, 0, 3, 8 or 15]:
    coefficients of the spherical harmonics of degree 0 and of higher degrees. Viewers add 1/2 to their sum.

    Raises
    ------
    InputError
        As `write_ply` does.
    """
    centres, scales, quaternions, opacity = (np.asarray(a, float) for a in (centres, scales, quaternions, opacity))
    check_cloud(path, centres, scales, quaternions, opacity, 'opacity')
    quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    opacity = np.clip(opacity, 1e-12, 1 - 1e-12)  # the ends have no logit
    rest = np.zeros((len(opacity), _REST))
    rest[:, : np.shape(harmonics)[1]] = harmonics
    names = [
        *_CENTRE,
        'nx',
        'ny',
        'nz',
        *(f'f_dc_{i}' for i in range(3)),
        *(f'f_rest_{i}' for i in range(3 * _REST)),
        'opacity',
        *_SCALE,
        *_ROT,
    ]
    _write(
        path,
        names,
        np.concatenate(
            [
                centres,
                np.zeros((len(opacity), 3)),
                np.repeat(np.reshape(radiance, (-1, 1)), 3, 1),
                np.tile(rest, 3),
                (np.log(opacity) - np.log1p(-opacity))[:, None],
                np.log(scales),
                quaternions[:, [3, 0, 1, 2]],
            ],
            1,
        ),
    )


def _write(path, names, table):
    header = ''.join(
        [
            'ply\nformat binary_little_endian 1.0\n',
            f'element vertex {len(table)}\n',
            *(f'property float {name}\n' for name in names),
            'end_header\n',
        ]
    )
    with replacing(path) as temporary, open(temporary, 'wb') as stream:
        stream.write(header.encode('ascii') + np.ascontiguousarray(table, '<f4').tobytes())


def _header(stream, where):
    """(number of vertices, dtype of one vertex); leaves the stream at the first vertex."""

    def fail(what):
        raise InputError(f'{where}: {what}; a binary little-endian PLY file of Gaussians is needed')

    if stream.readline(16).strip() != b'ply':
        fail('is not a PLY file')
    lines = []
    while not lines or lines[-1] != ['end_header']:
        line = stream.readline(256)
        if not line or len(lines) > 1000:
            fail('its header has no end')
        lines.append(line.decode('ascii', 'replace').split())
    lines = [line for line in lines[:-1] if line and line[0] not in ('comment', 'obj_info')]
    if lines[:1] != [['format', 'binary_little_endian', '1.0']]:
        fail('is not in the format binary_little_endian 1.0')
    elements = [line for line in lines if line[0] == 'element']
    if len(elements) != 1 or elements[0][1:2] != ['vertex'] or len(elements[0]) != 3 or not elements[0][2].isdigit():
        fail("must have the one element 'vertex'")
    fields = [line for line in lines if line[0] == 'property']
    if any(len(f) != 3 or f[1] not in _TYPES for f in fields) or len({f[-1] for f in fields}) != len(fields):
        fail('has lists, unknown types or repeated names among its properties')
    return int(elements[0][2]), np.dtype([(f[2], _TYPES[f[1]]) for f in fields])


def require_elements(path: PathLike | str) -> None:
    """Raises InputError unless a PLY file of any kind has a header with elements, and room for them: Mitsuba's readers end the
    process if there are none."""

    def fail(what):
        raise InputError(f'{path}: is a damaged PLY file: {what}; write it again')

    elements, as_text = [], True  # [count, least bytes of one]
    with reading(path), open(path, 'rb') as stream:
        line = stream.readline(_LONGEST_LINE).split()
        if line != [b'ply']:
            fail('it does not begin with ply')
        while line != [b'end_header']:
            line = stream.readline(_LONGEST_LINE).split()
            if not line and stream.tell() >= os.fstat(stream.fileno()).st_size or stream.tell() > _LONGEST_HEADER:
                fail('its header has no end')
            if line[:1] == [b'element']:
                if len(line) != 3 or not line[2].isdigit() or len(line[2]) > 18:
                    fail('an element has no count')
                elements.append([int(line[2]), 0])
            elif line[:1] == [b'property']:
                if not elements:
                    fail('a property belongs to no element')
                kind = _TYPES.get(line[1].decode('ascii', 'replace') if len(line) == 3 else '')
                elements[-1][1] += 1 if kind is None or as_text else np.dtype(kind).itemsize
            elif line[:1] == [b'format']:
                as_text = line[1:2] == [b'ascii']
        left = os.fstat(stream.fileno()).st_size - stream.tell()
    if not elements or not all(size for _, size in elements):
        fail('its header announces no elements, or some without properties')
    if sum(count * size for count, size in elements) > left:
        fail(f'its header announces more than its {left} bytes of data')


def read_ply(path: PathLike | str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reads a cloud: (centres [N, 3], scales [N, 3], quaternions [N, 4] (x, y, z, w), density [N]), float32.

    Properties may come in any order; all but centre, scale, rot and density are ignored.

    Raises
    ------
    InputError
        If the file is missing, truncated, has no density, or holds values that `write_ply` would refuse.
    """
    with reading(path), open(path, 'rb') as stream:
        n, dtype = _header(stream, path)
        missing = [name for name in (*_CENTRE, 'density', *_SCALE, *_ROT) if name not in (dtype.names or ())]
        if missing:
            raise InputError(f'{path}: has no property {missing[0]}; write the cloud with lingo_mi')
        size = os.fstat(stream.fileno()).st_size - stream.tell()
        if size != n * dtype.itemsize:
            raise InputError(
                f'{path}: has {size} bytes of data, but {n} Gaussians need '
                f'{n * dtype.itemsize}; it is truncated or damaged, write it again'
            )
        require_room(size + 80 * n, path)
        body = stream.read()
    rows = np.frombuffer(body, dtype)

    def take(names):
        return np.stack([rows[name] for name in names], -1).astype(np.float32)

    with np.errstate(over='ignore'):
        scales = np.exp(take(_SCALE))
    cloud = take(_CENTRE), scales, take((*_ROT[1:], _ROT[0])), rows['density'].astype(np.float32)
    check_cloud(path, *cloud)
    return cloud
