"""The voxels behind a header: as they are, or compressed. What the header claims is compared with the file first."""

from __future__ import annotations

import bz2
import gzip
import math
import os
import zlib
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import require_room
from lingo_mi.storage.file_access import reading

MOST_DEFLATED = 1032  # bytes that a byte of deflate can stand for
_CHUNK = 1 << 20
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])  # DICOM's and ITK's axes, and NIfTI's


def require_claim(path: PathLike | str, shape: Sequence[int], dtype: np.dtype, ratio: float = 1, start: int = 0) -> int:
    """Bytes that an array of a file has.

    Parameters
    ----------
    ratio : float
        Bytes that one byte of the file may stand for: 1 unless it is compressed.
    start : int
        Bytes of the (unpacked) file before the array.

    Raises
    ------
    InputError
        If the file is too short for it, or the memory too small.
    """
    if min(shape, default=0) < 1 or start < 0 or dtype.hasobject or dtype.itemsize == 0:
        raise InputError(f'{path}: is damaged: its header claims the shape {list(shape)} of {dtype}; fetch it again')
    count = math.prod(shape)
    if start + count * dtype.itemsize > os.path.getsize(path) * ratio:
        raise InputError(
            f'{path}: is truncated or damaged: its header claims the shape {shown(list(shape))} of {dtype}, which its '
            f'{os.path.getsize(path)} bytes cannot hold; fetch it again'
        )
    # Unpacked, as float32, and once more while values become densities.
    require_room(count * ((dtype.itemsize if ratio > 1 else 0) + 8), path)
    return count * dtype.itemsize


def read_exactly(stream: Any, path: PathLike | str, size: int) -> bytes:
    """`size` bytes of a stream that unpacks what is read of it.

    Raises
    ------
    InputError
        If it ends before.
    """
    content = stream.read(size)
    if len(content) < size:
        raise InputError(f'{path}: is truncated or damaged: its data end too early; fetch it again')
    return content


def require_end(stream: Any, path: PathLike | str) -> None:
    """Go on to the end of a stream that unpacks, where gzip's checksum is.

    Raises
    ------
    InputError
        If more than 1 MiB follow.
    """
    left = _CHUNK
    while got := len(stream.read(_CHUNK)):
        left -= got
        if left < 0:
            raise InputError(f'{path}: is damaged: more data follow than its header says; fetch it again')


def read_voxels(
    path: PathLike | str, start: int, shape: Sequence[int], dtype: Any, packing: str | None = None
) -> np.ndarray:
    """An array [x, y, z] of a file, x fastest.

    Parameters
    ----------
    start : int
        Bytes before it; -1: it is the file's end.
    packing : str or None
        None, 'deflate' (zlib's or gzip's) or 'bzip2'.

    Raises
    ------
    InputError
        If the file cannot hold what is asked for, is damaged or is not a regular file.
    """
    dtype = np.dtype(dtype)
    with reading(path):
        if packing is None:
            size = require_claim(path, shape, dtype, start=max(start, 0))
            start = os.path.getsize(path) - size if start < 0 else start
            values = np.fromfile(path, dtype, math.prod(shape), offset=start)
            return values.reshape(tuple(shape), order='F')
        size = require_claim(path, shape, dtype, MOST_DEFLATED if packing == 'deflate' else math.inf)
        try:
            if start >= os.path.getsize(path):
                raise InputError(f'{path}: is truncated or damaged: its data begin after its end; fetch it again')
            with open(path, 'rb') as file:
                file.seek(start)
                gzipped = packing == 'deflate' and file.read(2) == b'\x1f\x8b'
                file.seek(start)
                if packing == 'deflate' and not gzipped:
                    content = _inflated(file.read(), size)
                else:
                    stream = gzip.GzipFile(fileobj=file) if gzipped else bz2.BZ2File(file)
                    content = read_exactly(stream, path, size)
                    require_end(stream, path)
        except (EOFError, zlib.error, OSError) as error:
            raise InputError(f'{path}: is damaged: its data cannot be unpacked ({error}); fetch it again') from None
    return np.frombuffer(content, dtype).reshape(tuple(shape), order='F')


def _inflated(content: bytes, size: int) -> bytes:
    """`size` bytes of zlib's. Raises EOFError if it ends before or behind them, or its checksum is missing."""
    unpacker = zlib.decompressobj()
    out = unpacker.decompress(content, size)
    if unpacker.decompress(unpacker.unconsumed_tail, 1) or len(out) < size or not unpacker.eof:
        raise EOFError('they do not have the size that the header says')
    return out
