"""Mutations of a good file: bytes, fields of a header, words of a text, and the data from which a file is written."""

from __future__ import annotations

import copy
import gzip
import io
import re
import struct
import zipfile
from random import Random
from typing import Any

import numpy as np

from studies.fuzz.corpus import Structured, zipped

LONGEST = 1 << 18  # bytes of a mutated file
TOKENS = [
    b'-1', b'0', b'1', b'2', b'100', b'4294967296', b'999999999999', b'1e308', b'1e-308', b'nan', b'inf', b'-inf', b'1e400',
    b'9' * 400, b'9' * 5000, b'', b'x' * 5000, b'%n%n%s%s', b'..', b'/etc/hostname', b'../../v.raw', b'LIST', b'LOCAL', b'true',
    b'\0', b'\xff', b'\n', b'1 2 3', b'[[[', b'{', b'&a', b'*a', b'<', b'&', b'1.5', b'-0.0', b'0x10', b'1_0', b'\xc2\xb2',
]  # fmt: skip
NUMBERS = [0, 1, -1, 2, 127, 128, 255, 256, 32767, 32768, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1]
FLOATS = [0.0, -1.0, float('nan'), float('inf'), -float('inf'), 1e308, 1e-308, 1e38, 1e-38]
DATA = [
    None, True, False, 0, 1, -1, 2, 3.5, 1e308, 1e-308, 1e300, float('nan'), float('inf'), 2**31, 2**63, 10**30, 10**400,
    10**5000, '', 'x', 'x' * 2000, 'x' * 20000, '1e308', 'nan', '..', '/etc/hostname', '../v.npy', 'v.npy', 'cone', 'parallel',
    'a\0b', '\ud800', 'p.xml', [], {}, [1], [[1], [1, 2]], [1, 2], [1.0, 2, 3], [None], ['a', 2], {'a': 1}, [[[[1]]]], b'bytes',
    1j, (1, 2), np.ones(3), np.ones((2, 2)), np.ones(0), np.array('a'), np.array([True]), np.float32(3), np.int64(7),
    np.ones((3, 4, 5), 'i8'), np.full((3, 4, 5), 1e300), np.full((3, 4, 5), np.nan), np.ones((3, 4, 5), complex),
    np.array([1], '>f8'),
]  # fmt: skip


def mutated(original: bytes | Structured, name: str, rng: Random) -> bytes:
    """The content of a file after some mutations; `name` tells what it is packed in."""
    if isinstance(original, Structured):
        if rng.random() < 0.6:
            data = copy.deepcopy(original.data)
            for _ in range(rng.choice((1, 1, 2, 3))):
                data = _data(data, rng)
            try:
                return original.dump(data)
            except Exception:  # the format cannot hold the value
                pass
        original = original.content()
    if rng.random() < 0.5:
        if name.endswith('.gz'):
            return gzip.compress(_bytes(gzip.decompress(original), rng), 1, mtime=0)
        if name.endswith('.npz'):
            with zipfile.ZipFile(io.BytesIO(original)) as archive:
                members = {name: archive.read(name) for name in archive.namelist()}
            chosen = rng.choice(list(members))
            return zipped(members | {chosen: _bytes(members[chosen], rng)})
    return _bytes(original, rng)


def _bytes(content: bytes, rng: Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 20))):
        content = rng.choice(_WAYS)(content, rng)[:LONGEST] or b'\0'
    return content


def _place(content, rng):
    """Return a random place: usually in the first half kilobyte, which holds the headers."""
    return rng.randrange(min(len(content), 512) if rng.random() < 0.7 else len(content))


def _flip(content, rng):
    at = _place(content, rng)
    return content[:at] + bytes([content[at] ^ (1 << rng.randrange(8))]) + content[at + 1 :]


def _replace(content, rng):
    at, size = _place(content, rng), rng.choice((1, 1, 2, 4, 8, 16, 64))
    filler = rng.choice((b'\0' * size, b'\xff' * size, b'\x80' * size, rng.randbytes(size)))
    return content[:at] + filler + content[at + size :]


def _number(content, rng):
    kind = rng.choice('bhiqHIQfd')
    order = rng.choice('<>')
    if kind in 'fd':
        value = rng.choice(FLOATS)
        value = value if kind == 'd' or not abs(value) > 3e38 else float('inf')
        field = struct.pack(order + kind, value)
    else:
        size = struct.calcsize(order + kind)
        field = (rng.choice(NUMBERS) & (256**size - 1)).to_bytes(size, 'little' if order == '<' else 'big')
    at = _place(content, rng)
    at -= at % len(field) if rng.random() < 0.5 else 0
    return content[:at] + field + content[at + len(field) :]


def _insert(content, rng):
    at, size = _place(content, rng), rng.choice((1, 2, 4, 16, 300))
    return content[:at] + rng.choice((b'\0' * size, rng.randbytes(size), content[at : at + size])) + content[at:]


def _delete(content, rng):
    at = _place(content, rng)
    return content[:at] + content[at + rng.choice((1, 2, 4, 16, 64)) :]


def _truncate(content, rng):
    return content[: _place(content, rng)]


def _extend(content, rng):
    return content + rng.choice((b'\0', b'\xff', content, b'\0' * 5000, rng.randbytes(50)))


def _swap(content, rng):
    a, b = sorted((_place(content, rng), _place(content, rng)))
    size = rng.choice((1, 4, 16))
    if b - a < size:
        return content
    return content[:a] + content[b : b + size] + content[a + size : b] + content[a : a + size] + content[b + size :]


def _word(content, rng):
    """Another word or number in the place of one of a text, where the file begins with a text."""
    words = [m.span() for m in re.finditer(rb'[-+.\w]+', content[:4000])]
    if not words:
        return content
    start, end = rng.choice(words)
    if rng.random() < 0.3:
        other = slice(*rng.choice(words))
        return content[:start] + content[other] + content[end:]
    return content[:start] + rng.choice(TOKENS) + content[end:]


def _line(content, rng):
    lines = content.split(b'\n')
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    way = rng.randrange(4)
    if way == 0:
        lines.insert(other, lines[at])
    elif way == 1:
        del lines[at]
    elif way == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = lines[at][:2000] * rng.choice((2, 50, 2000))
    return b'\n'.join(lines)


_WAYS = [_flip, _replace, _number, _number, _insert, _delete, _truncate, _extend, _swap, _word, _word, _line]


def _data(value: Any, rng: Random) -> Any:
    """`value` with one of its parts replaced, removed, wrapped or repeated."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        way = rng.random()
        if way < 0.1:
            return {k: v for k, v in value.items() if k != key}
        if way < 0.15:
            return value | {rng.choice(('x' * 400, 'a\nb', 'pitch', 'z', 'poses', 'valid', 'angles')): rng.choice(DATA)}
        return value | {key: _data(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.7:
        at = rng.randrange(len(value))
        way = rng.random()
        if way < 0.15:
            return value[:at] + value[at + 1 :]
        if way < 0.3:
            return value + [value[at]]
        return value[:at] + [_data(value[at], rng)] + value[at + 1 :]
    way = rng.random()
    if way < 0.1:
        return [value]
    if way < 0.15:
        for _ in range(rng.choice((5, 50, 500))):
            value = [value]
        return value
    if way < 0.3 and isinstance(value, np.ndarray) and value.ndim and value.dtype.kind in 'buif':
        return rng.choice((value[:-1], value[..., None], value.astype('f8') * 1e300, value.astype('i2'), value.T))
    return rng.choice(DATA)
