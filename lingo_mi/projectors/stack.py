"""Stacks of images and volumes on the device: what the projector pairs of iterative algorithms share (Dr.Jit, llvm or cuda).

Volumes are mi.Float [nx * ny * nz], z fastest; images mi.Float [block, u, v], v fastest.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.upload import uploaded

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class Block:
    """Some views of a scan, on the device.

    Parameters
    ----------
    numbers
        mi.UInt, with an extra entry: an array of length one would need another kernel.
    count
        How many, mi.UInt [1].
    """

    numbers: Any
    count: Any

    @classmethod
    def of(cls, views: Views) -> Block:
        """The views with these numbers."""
        if isinstance(views, Block):
            return views
        return cls(mi.UInt([*map(int, views), 0]), dr.opaque(mi.UInt, len(views)))

    def __len__(self) -> int:
        return dr.width(self.numbers) - 1


Views = Sequence[int] | np.ndarray | Block


class Stack:
    """Volumes and stacks of images of a scan on the device.

    Attributes
    ----------
    size, panel
        Voxels along x, y and z; rows and columns.
    valid
        Images of all views on the device, 1 for valid pixels and 0 for others; None: all are valid.

    Raises
    ------
    InputError
        For 2^32 voxels or more.
    """

    ARRAYS: tuple[str, ...] = ()  # attributes on the device
    SETTINGS: tuple[str, ...] = ('size', 'panel')  # Python's

    def __init__(self, geometry: Geometry, valid: np.ndarray | None = None):
        self.geometry, self.size, self.panel = geometry, geometry.grid.shape, geometry.nDetector
        if self.voxels >= 2**32:
            raise InputError(f'{self.voxels} voxels are too many for one volume: lower nVoxel')
        self.valid = None if valid is None else self.images(valid)

    @property
    def voxels(self) -> int:
        return prod(self.size)

    @property
    def pixels(self) -> int:
        return prod(self.panel)

    @property
    def arrays(self) -> tuple[Any, ...]:
        return tuple(getattr(self, name) for name in self.ARRAYS)

    @property
    def settings(self) -> tuple[Any, ...]:
        return tuple(getattr(self, name) for name in self.SETTINGS)

    @classmethod
    def of(cls, arrays: Sequence[Any], settings: Sequence[Any]) -> Self:
        """A stack or projector with these `arrays` and `settings`, without a geometry."""
        out = cls.__new__(cls)
        vars(out).update(zip((*cls.ARRAYS, *cls.SETTINGS), (*arrays, *settings)))
        return out

    def used(self, view: Any, u: Any, v: Any) -> Any:
        """Return whether pixels are valid."""
        if self.valid is None:
            return mi.Bool(True)
        return dr.gather(mi.Float, self.valid, (view * self.panel[1] + u) * self.panel[0] + v) > 0

    def pixels_of(self, block: Block) -> tuple[Any, Any, Any]:
        """(view, u, v) of the pixels of images of some views, mi.UInt."""
        index = dr.arange(mi.UInt, len(block) * self.pixels)
        column = index // self.panel[0]
        place = column // self.panel[1]
        return dr.gather(mi.UInt, block.numbers, place), column - place * self.panel[1], index - column * self.panel[0]

    def images(self, projections: np.ndarray) -> Any:
        """Projections [view, v, u] as device images, mi.Float [view, u, v]."""
        return uploaded(np.asarray(projections).transpose(0, 2, 1))

    def select(self, images: Any, views: Views) -> Any:
        """The images of the views `views` out of the images of all views."""
        view, u, v = self.pixels_of(Block.of(views))
        return dr.gather(mi.Float, images, (view * self.panel[1] + u) * self.panel[0] + v)


class Gathered(Stack, ABC):
    """The matrix A of a scan, with zero rows for invalid pixels, both ways by gathers. `adjoint` is its transpose to rounding.

    Nothing is scattered, so results do not depend on the order of threads. The same compiled kernels (one forward, two backward)
    serve blocks of any number of views.
    """

    def forward(self, volume: Any, views: Views) -> tuple[Any, Any]:
        """Line integrals of a volume in the views `views` (integers): (A x, A 1), each mi.Float [block, u, v].

        A 1 is the length of the ray inside the box, mm; zero for invalid pixels.
        """
        pixels = self.pixels_of(Block.of(views))
        ax, path = self._integrate(volume, *pixels)
        used = self.used(*pixels)
        return dr.select(used, ax, 0), dr.select(used, path, 0)

    def adjoint(self, images: Any, views: Views, rule: Callable[[Any, Any, Any], Any] | None = None) -> Any:
        """Backprojection A^T y of images of the views `views`, summed over these views: mi.Float [voxels].

        Parameters
        ----------
        images
            mi.Float [block, u, v].
        rule : callable or None
            Function of (voxel, A^T y, A^T 1), with flat indices mi.UInt of some voxels and their sums; its result is stored
            instead. It is traced into the kernel, which saves memory for whole volumes.
        """
        block, ones = Block.of(views), rule is not None
        weighted = self._weighted(images, block, ones)
        dr.eval(weighted)
        voxels, sums = self._collect(weighted, block, ones)
        out = dr.empty(mi.Float, self.voxels)
        for voxel, inside, value in zip(*voxels, sums):
            value = value[0] if rule is None else rule(dr.select(inside, voxel, 0), *value)
            dr.scatter(out, value, voxel, inside, mode=dr.ReduceMode.Permute)
        return out

    @abstractmethod
    def _integrate(self, volume: Any, view: Any, u: Any, v: Any) -> tuple[Any, Any]:
        """(A x, A 1) of rays through pixels, valid or not, one per lane."""

    @abstractmethod
    def _weighted(self, images: Any, block: Block, ones: bool) -> Any:
        """Images of some views times the path per slice, for `_collect`; 0 for invalid pixels.

        With `ones`, mi.Vector2f interleaved: the second component comes from an image of ones, treated alike.
        """

    @abstractmethod
    def _collect(self, weighted: Any, block: Block, ones: bool) -> tuple[Any, Any]:
        """A^T y of voxels: ((voxels, whether they exist), sums), lists of as many as a lane computes.

        A sum is a list; with `ones`, its second entry is A^T 1.

        Parameters
        ----------
        weighted
            See `_weighted`.
        """


def lanes(size: tuple[int, int, int], run: int) -> tuple[tuple[Any, Any], tuple[Any, Any, Any], int]:
    """Voxels for lanes that compute `run` (or all) of a line along z, spaced as far apart as possible.

    Neighbouring lanes then fetch neighbouring values.

    Returns
    -------
    tuple[tuple[Any, Any], tuple[Any, Any, Any], int]
        (flat indices of a lane's voxels, whether they exist), its first voxel (x, y, z) as floats, and the step along z.
    """
    _, ny, nz = size
    run = min(run, nz)
    stride = -(-nz // run)
    index = dr.arange(mi.UInt, size[0] * ny * stride)
    line = index // stride
    first_z = index - line * stride
    voxels = [line * nz + first_z + s * stride for s in range(run)]
    exists = [first_z + s * stride < nz for s in range(run)]
    x = mi.Float(line // ny)
    return (voxels, exists), (x, mi.Float(line) - x * ny, mi.Float(first_z)), stride


def hat(position: Any, index: Any, n: Any) -> Any:
    """Weight of grid index `index` at a position along an axis of n voxels, edge values held for half a voxel."""
    weight = dr.maximum(1 - dr.abs(dr.clip(position, 0, n - 1) - index), 0)
    return dr.select((position >= -0.5) & (position <= n - 0.5), weight, 0)


def sampled(data: Any, inside: Any, first: Any, position: Any, counts: Any, strides: Any) -> Any:
    """A slice of a volume, interpolated bilinearly; edge values are held.

    Parameters
    ----------
    first
        Flat index of the slice's first voxel.
    position, counts
        Along both axes: in voxels, and how many there are.
    strides
        Strides from voxel to voxel, mi.UInt.
    """
    y, z = (dr.clip(p, 0, n - 1) for p, n in zip(position, counts))
    j, k = dr.floor(y), dr.floor(z)
    fy, fz = y - j, z - k
    near = first + mi.UInt(j) * strides[0] + mi.UInt(k) * strides[1]
    up, far = dr.select(fz > 0, strides[1], 0), near + dr.select(fy > 0, strides[0], 0)
    p = [dr.gather(mi.Float, data, i, inside) for i in (near, near + up, far, far + up)]
    p0, p1 = dr.fma(fz, p[1] - p[0], p[0]), dr.fma(fz, p[3] - p[2], p[2])
    return dr.fma(fy, p1 - p0, p0)


def span(a: Any, b: Any, n: Any) -> tuple[Any, Any]:
    """First and last index m >= 0 at which a + b m may be in [-1/2, n - 1/2], as floats; too many are harmless."""
    inv = dr.rcp(dr.select(dr.abs(b) < 1e-12, 1e-12, b))
    p, q = (-0.51 - a) * inv, (n - 0.49 - a) * inv  # a little more: a ray may run along a face
    return dr.minimum(p, q), dr.maximum(p, q)
