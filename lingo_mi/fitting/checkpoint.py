"""Checkpoints: all that a fit needs to continue exactly as without the interruption.

A checkpoint is an uncompressed .npz of the entries that `checkpoint_schema` names and one more, `checksum`. It is made of the
check sums that a zip archive keeps of its entries, which are compared in any case, so that it costs no time.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.checkpoint_schema import VERSION, require_sound
from lingo_mi.fitting.state import State
from lingo_mi.storage.file_access import replacing
from lingo_mi.storage.output_folder import CHECKPOINT, begin

LONGEST_HEADER = 2**16  # bytes of a .npy's


def save(path: PathLike | str, state: State, extra: dict, arrays: dict | None = None) -> None:
    """Write a state and plain values (`extra`, as JSON) atomically: after a crash, the previous checkpoint is intact.

    arrays   further NumPy arrays to store, by name

    One of the name checkpoint.npz is part of the result in its folder (see `output_folder.begin`).
    Raises InputError if it cannot be written.
    """
    path = Path(path)
    columns = {f'{group}.{k}': v for group in ('values', 'first', 'second') for k, v in getattr(state, group).items()}
    content: dict[str, Any] = dict(
        gradient=state.gradient,
        seen=state.visits,  # the name of earlier versions
        born=state.born,
        extra=np.array(json.dumps(extra | dict(version=VERSION), default=np.generic.item)),
        **columns,
        **{f'array.{k}': v for k, v in (arrays or {}).items()},
    )
    content['checksum'] = np.array(_checksum((name, _Crc.of(array)) for name, array in content.items()))
    with replacing(path) as temporary:
        with open(temporary, 'wb') as file:
            np.savez(file, **content)
        if path.name == CHECKPOINT:  # as late as can be: until then an old result in the folder is whole
            begin(path.parent, [CHECKPOINT])


def load(path: PathLike | str) -> tuple[State, dict, dict]:
    """The state, the plain values and the further arrays of a checkpoint.

    Raises InputError if the file is missing or is not a sound checkpoint (see `checkpoint_schema`). Loading never runs code from
    the file, and takes no more memory than its size tells.
    """
    try:
        data, summed = _read(path)
        extra = json.loads(_text(data.pop('extra')))
        require_sound(data, extra)
        if not summed and 'version' in extra:
            raise InputError('checksum is missing')
    except FileNotFoundError:
        raise InputError(f'{path}: no such file, so there is no checkpoint to go on from') from None
    except InputError as error:
        raise InputError(f'{path}: this is not a checkpoint of a fit, or it is damaged: {error}; start again') from None
    except (OSError, KeyError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, struct.error) as error:
        what = 'extra is missing' if isinstance(error, KeyError) else type(error).__name__
        raise InputError(f'{path}: this is not a checkpoint of a fit, or it is damaged: {what}; start again') from None
    extra.pop('version', None)
    names = [k[7:] for k in data if k.startswith('values.')]
    state = State(
        *({k: data[f'{group}.{k}'] for k in names} for group in ('values', 'first', 'second')),
        gradient=data['gradient'],
        visits=data['seen'],
        born=data['born'],
    )
    return state, extra, {k[6:]: v for k, v in data.items() if k.startswith('array.')}


def _read(path: PathLike | str) -> tuple[dict[str, np.ndarray], bool]:
    """The entries but for the checksum, by name, and whether there is one. What they claim to hold is compared with the size of
    the file before memory is taken."""
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError('it is no regular file')
    with open(path, 'rb') as file, zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if any(e.compress_type for e in entries) or sum(e.file_size for e in entries) > status.st_size:
            raise InputError('its entries are compressed, or larger than the file')
        data = {e.filename.removesuffix('.npy'): _array(file, e) for e in entries}
    if len(data) < len(entries):
        raise InputError('an entry is there twice')
    stored, sums = data.pop('checksum', None), {e.filename.removesuffix('.npy'): e.CRC for e in entries}
    sums.pop('checksum', None)
    if stored is not None and _text(stored) != _checksum(sums.items()):
        raise InputError('its checksum is wrong')
    return data, stored is not None


def _text(array: np.ndarray) -> str:
    """The text in an array of one. Raises InputError where there is none."""
    if array.ndim or array.dtype.kind != 'U':
        raise InputError('extra and checksum must be texts')
    return array.item()


def _array(file: io.BufferedReader, entry: zipfile.ZipInfo) -> np.ndarray:
    """The array in an entry, writable, from the file straight into its memory. Raises InputError where the entry's check sum is
    wrong, or its header claims another size than it has, or objects."""
    file.seek(entry.header_offset + 26)  # where the lengths stand of what goes before the content
    name, more = struct.unpack('<HH', file.read(4))
    file.seek(name + more, os.SEEK_CUR)
    content = bytearray(entry.file_size)
    if file.readinto(content) != len(content) or zlib.crc32(content) != entry.CRC:
        raise InputError('the check sum of an entry is wrong')
    header = io.BytesIO(content[:LONGEST_HEADER])
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, columns_first, kind = read[np.lib.format.read_magic(header)](header)
    except (KeyError, MemoryError, SyntaxError, TypeError, ValueError, tokenize.TokenError):  # an expression
        raise InputError('an entry is no array') from None
    count, begin = math.prod(shape), header.tell()
    if kind.hasobject or any(n < 0 for n in shape) or count * kind.itemsize != len(content) - begin:
        raise InputError('an entry claims another size than it has')
    values = np.frombuffer(content, kind, count, begin) if count * kind.itemsize else np.empty(count, kind)
    return values.reshape(shape, order='F' if columns_first else 'C')


def _checksum(sums: Iterable[tuple[str, int]]) -> str:
    """One sum over those of all entries, by name."""
    return hashlib.blake2b(json.dumps(sorted(sums)).encode(), digest_size=16).hexdigest()


class _Crc:
    """A file that keeps nothing of what is written to it but the check sum."""

    def __init__(self):
        self.value = 0

    def write(self, content) -> None:
        self.value = zlib.crc32(content, self.value)

    @classmethod
    def of(cls, array: np.ndarray) -> int:
        """The check sum that a zip archive has of an array's .npy."""
        file = cls()
        np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
        return file.value
