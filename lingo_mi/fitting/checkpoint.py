"""Checkpoints: all that a fit needs to continue exactly as without the interruption.

A checkpoint is an uncompressed .npz of the entries that `checkpoint_schema` names and one more, `checksum`. It is made of the
checksums that a zip archive keeps of its entries, which are compared in any case, so that it costs no time.
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
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.checkpoint_schema import PLAIN, VERSION, require_sound
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.state import State
from lingo_mi.geometry.base import Geometry
from lingo_mi.scene.description import describe
from lingo_mi.storage.file_access import replacing
from lingo_mi.storage.output_folder import CHECKPOINT, begin

LONGEST_HEADER = 2**16  # bytes of a .npy's


@dataclass
class Checkpoint:
    """A fit between two steps.

    Attributes
    ----------
    method : Method
        With the limits that the scan sets.
    geometry : Geometry
        Geometry of the scan, as given.
    unit : float
        The density that the fit counts as 1, in 1/mm.
    state : State
        All parameters, their moments, the densification statistic.
    arrays : dict
        By name: `initial`, the points that the fit started from, float32 [M, 3]; `order`, the views that come next;
        `losses`, the losses of the last pass; the mean of the last steps; and the arrays of the corrections.
    seed : int
        Seed of all random choices.
    rng : dict
        State of the generator of the views' order, the total variation's cubes and splits.
    iteration : int
        Steps done.
    seconds : float
        Spent in steps.
    history : list of dict
        Measurements over time.
    info : dict
        Measurements of the start.
    scan : dict
        Numbers that tell the scan from others; see `resume.identity`.
    effects : bool
        Whether the fit models effects of the scan, which a checkpoint does not hold.
    search : dict or None
        Record of the search for the last step; see `stopping`.
    seen : int
        Views that the steps see: all, but for a search.
    """

    method: Method
    geometry: Geometry
    unit: float
    state: State
    arrays: dict[str, np.ndarray]
    seed: int
    rng: dict
    iteration: int
    seconds: float
    history: list[dict]
    info: dict
    scan: dict
    effects: bool
    search: dict | None
    seen: int

    @property
    def searching(self) -> bool:
        """True if the checkpoint belongs to a search for the last step, and not to the fit itself."""
        return self.seen < len(self.geometry)

    def save(self, path: PathLike | str) -> None:
        """Write the file atomically: after a crash, the previous one is intact.

        One of the name checkpoint.npz is part of the result in its folder (see `output_folder.begin`).

        Raises
        ------
        InputError
            If it cannot be written.
        """
        path, state = Path(path), self.state
        plain = dict(
            version=VERSION,
            method=self.method.name,
            settings=self.method.flat(),
            scanner=describe(self.geometry),
            **{name: getattr(self, name) for name in PLAIN},
        )
        groups = ('values', 'first', 'second')
        content: dict[str, Any] = dict(
            gradient=state.gradient,
            visits=state.visits,
            born=state.born,
            extra=np.array(json.dumps(plain, default=np.generic.item)),
            **{f'{group}.{k}': v for group in groups for k, v in getattr(state, group).items()},
            **{f'array.{k}': v for k, v in self.arrays.items()},
        )
        content['checksum'] = np.array(checksum_of((name, _Crc.of(array)) for name, array in content.items()))
        with replacing(path) as temporary:
            with open(temporary, 'wb') as file:
                np.savez(file, **content)
            if path.name == CHECKPOINT:  # as late as can be: until then an old result in the folder is whole
                begin(path.parent, [CHECKPOINT])

    @classmethod
    def load(cls, path: PathLike | str) -> Checkpoint:
        """The fit in a file.

        Loading never runs code from the file, and takes no more memory than its size suggests.

        Raises
        ------
        InputError
            If the file is missing or is not a sound checkpoint (see `checkpoint_schema`).
        """
        try:
            data = _read(path)
            plain = json.loads(_text(data.pop('extra')))
            method, geometry = require_sound(data, plain)
        except FileNotFoundError:
            raise InputError(f'{path}: no such file, so there is no checkpoint to go on from') from None
        except InputError as error:
            raise InputError(
                f'{path}: this is not a checkpoint of a fit, or it is damaged: {error}; start again'
            ) from None
        except (OSError, KeyError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, struct.error) as error:
            what = 'extra is missing' if isinstance(error, KeyError) else type(error).__name__
            raise InputError(
                f'{path}: this is not a checkpoint of a fit, or it is damaged: {what}; start again'
            ) from None
        names = [k[7:] for k in data if k.startswith('values.')]
        state = State(
            *({k: data[f'{group}.{k}'] for k in names} for group in ('values', 'first', 'second')),
            gradient=data['gradient'],
            visits=data['visits'],
            born=data['born'],
        )
        arrays = {k[6:]: v for k, v in data.items() if k.startswith('array.')}
        return cls(method, geometry, state=state, arrays=arrays, **{name: plain[name] for name in PLAIN})


def _read(path: PathLike | str) -> dict[str, np.ndarray]:
    """The entries without the checksum, by name. Their claimed sizes are compared with the size of the file before memory is
    taken."""
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError('it is not a regular file')
    with open(path, 'rb') as file, zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if any(e.compress_type for e in entries) or sum(e.file_size for e in entries) > status.st_size:
            raise InputError('its entries are compressed, or larger than the file')
        data = {e.filename.removesuffix('.npy'): _array(file, e) for e in entries}
    if len(data) < len(entries):
        raise InputError('an entry is there twice')
    stored, sums = data.pop('checksum', None), {e.filename.removesuffix('.npy'): e.CRC for e in entries}
    sums.pop('checksum', None)
    if stored is None:
        raise InputError('its checksum is missing')
    if _text(stored) != checksum_of(sums.items()):
        raise InputError('its checksum is wrong')
    return data


def _text(array: np.ndarray) -> str:
    """The text in an array of one. Raises InputError if there is none."""
    if array.ndim or array.dtype.kind != 'U':
        raise InputError('extra and checksum must be texts')
    return array.item()


def _array(file: io.BufferedReader, entry: zipfile.ZipInfo) -> np.ndarray:
    """The array in an entry, writable, from the file straight into its memory. Raises InputError if the entry's checksum is
    wrong, or its header claims another size than it has, or objects."""
    file.seek(entry.header_offset + 26)  # the lengths of the parts before the content
    name, more = struct.unpack('<HH', file.read(4))
    file.seek(name + more, os.SEEK_CUR)
    content = bytearray(entry.file_size)
    if file.readinto(content) != len(content) or zlib.crc32(content) != entry.CRC:
        raise InputError('the checksum of an entry is wrong')
    header = io.BytesIO(content[:LONGEST_HEADER])
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, columns_first, kind = read[np.lib.format.read_magic(header)](header)
    except (KeyError, MemoryError, SyntaxError, TypeError, ValueError, tokenize.TokenError):  # NumPy evaluates it
        raise InputError('an entry is not an array') from None
    count, begin = math.prod(shape), header.tell()
    if kind.hasobject or any(n < 0 for n in shape) or count * kind.itemsize != len(content) - begin:
        raise InputError('an entry claims another size than it has')
    values = np.frombuffer(content, kind, count, begin) if count * kind.itemsize else np.empty(count, kind)
    return values.reshape(shape, order='F' if columns_first else 'C')


def checksum_of(sums: Iterable[tuple[str, int]]) -> str:
    """One checksum of the checksums of all entries, by name."""
    return hashlib.blake2b(json.dumps(sorted(sums)).encode(), digest_size=16).hexdigest()


class _Crc:
    """A file that keeps nothing of what is written to it but the checksum."""

    def __init__(self):
        self.value = 0

    def write(self, content) -> None:
        self.value = zlib.crc32(content, self.value)

    @classmethod
    def of(cls, array: np.ndarray) -> int:
        """The checksum that a zip archive has of an array's .npy."""
        file = cls()
        np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
        return file.value
