"""Arrays as text for a page: whole numbers of up to 16 bits with a step, differences, gzip, base64.

A value is `low + step * code`, right to half a step, which the page shows. `web/decode.js` undoes the rest. Codes are written as
differences of neighbours along the first axis, small sizes as small numbers (zigzag), all low bytes before all high ones: so
smooth volumes compress to a quarter.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

MOST_VOXELS = 256**3  # of a volume in a page; larger ones are shown as means of blocks
BITS = 16, 14, 12, 10, 8


@dataclass(frozen=True, eq=False)
class Packed:
    """An array as a page holds it: shape, `low` and `step` of its values, and its codes as text."""

    shape: tuple[int, ...]
    low: float
    step: float
    text: str

    def head(self) -> dict:
        """Return the data that the page needs beside the text."""
        return dict(shape=list(self.shape), low=self.low, step=self.step)


class Arrays(dict[str, Packed]):
    """The arrays of a page by name. Arrays that have not changed since an earlier state of the page are not packed again."""

    def __init__(self, earlier: Arrays | None = None):
        super().__init__()
        self._packed_from: dict[str, tuple[np.ndarray, float, float, int]] = {}
        self._earlier = (
            {} if earlier is None else {name: (earlier._packed_from[name], p) for name, p in earlier.items()}
        )

    def scale(self, name: str, low: float, high: float) -> tuple[float, float]:
        """The range to pack an array with: [low, high], or the earlier one if that holds it and is not too wide."""
        if name not in self._earlier:
            return low, high
        least, most = self._earlier[name][0][1:3]
        if least <= low and high <= most <= low + 2 * (high - low):
            return least, most
        return low, high + (high - low) / 4  # values of a fit go on growing

    def add(self, name: str, array: np.ndarray, low: float, high: float, bits: int = 16) -> None:
        """Pack an array (see `pack`), unless it was the same before."""
        self._packed_from[name] = array, low, high, bits
        before, packed = self._earlier.get(name, (None, None))
        same = before is not None and before[1:] == (low, high, bits) and np.array_equal(before[0], array)
        self[name] = packed if same and packed is not None else quantised(array, low, high, bits)


def quantised(array: np.ndarray, low: float, high: float, bits: int = 16, level: int = 5) -> Packed:
    """An array whose values lie in [low, high], the first axis the fastest; `low` is a code, and so is 0 if low <= 0 <= high."""
    low, step = _scale(low, high, bits)
    return Packed(array.shape, low, step, base64.b64encode(_compressed(array, low, step, level)).decode('ascii'))


def codes(array: np.ndarray, low: float, step: float) -> np.ndarray:
    """The whole numbers that stand for the values, uint16."""
    return np.clip(np.rint((array - low) / step), 0, 65535).astype(np.uint16)


def bits_within(arrays: Sequence[np.ndarray], low: float, high: float, budget: float) -> int | None:
    """The most bits with which arrays take no more than `budget` bytes as text, by a sample of their last axis; None: too few."""
    samples, share = [], 0.0
    for array in arrays:
        every = max(1, array.shape[-1] // 12)
        sample = array[..., every // 2 :: every]
        samples.append(sample)
        share = max(share, array.shape[-1] / sample.shape[-1])
    for bits in BITS:
        size = sum(len(_compressed(s, *_scale(low, high, bits), 5)) for s in samples) * share * 4 / 3
        if size <= budget:
            return bits
    return None


def preview(volume: np.ndarray, most: int = MOST_VOXELS) -> tuple[np.ndarray, int]:
    """The volume, or means of n^3 voxels if it has more than `most`; and n."""
    n = 1
    while volume.size / n**3 > most:
        n += 1
    return block_means(volume, n), n


def block_means(volume: np.ndarray, n: int) -> np.ndarray:
    """Means of n^3 voxels; voxels left over at the far end are left out. An axis of fewer than n becomes one voxel."""
    if n == 1:
        return volume
    mean = volume
    for axis, size in enumerate(volume.shape):  # one by one: all at once takes numpy five times as long
        by = min(n, size)
        whole = np.moveaxis(mean, axis, 0)[: size // by * by]
        mean = np.moveaxis(reduce(np.add, (whole[i::by] for i in range(by))), 0, axis) / np.float32(by)
    return mean


def _scale(low: float, high: float, bits: int) -> tuple[float, float]:
    step = (high - low) / (2**bits - 1) or 1.0
    if low < 0 < high:  # so that nothing is a value: low is a whole number of steps from 0
        step = (high - low) / (2**bits - 2)
        low = -step * np.ceil(-low / step)
    return float(low), float(step)


def _compressed(array: np.ndarray, low: float, step: float, level: int) -> bytes:
    flat = codes(array, low, step).ravel(order='F')
    change = np.diff(flat, prepend=flat[:1]).view(np.int16)  # modulo 2^16
    change[:1] = flat[:1].view(np.int16)
    folded = ((change << 1) ^ (change >> 15)).view(np.uint16)
    planes = (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
    return gzip.compress(planes, level, mtime=0)
