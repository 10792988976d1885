"""A box of voxels: how many, how large, and where.

A grid has a normalised frame, in which its longest side is 2 and its centre the origin. Lengths and line integrals are
multiplied by `Grid.scale` to get there; densities keep their number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole_number
from lingo_mi.geometry import limits


@dataclass(frozen=True, init=False)
class Grid:
    """A grid of voxels along x, y and z; two grids with the same numbers are equal.

    Parameters
    ----------
    shape : whole number or [3]
        Voxels (x, y, z), at least 1. Here and below, one number holds for all three.
    spacing : float or [3]
        Voxel size, (x, y, z), mm.
    centre : float or [3]
        Centre of the whole box, (x, y, z), mm.

    Raises
    ------
    InputError
        For wrong shapes, counts and sizes that are not positive, and numbers that are not finite or beyond the limits of
        `lingo_mi.geometry.limits`.

    Examples
    --------
    >>> Grid((512, 512, 300), 0.5).size
    (256.0, 256.0, 150.0)
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    centre: tuple[float, float, float]

    def __init__(self, shape: ArrayLike, spacing: ArrayLike, centre: ArrayLike = 0.0):
        object.__setattr__(self, 'shape', limits.counts('shape', shape, 3))
        object.__setattr__(self, 'spacing', limits.sizes('spacing', spacing, 3))
        object.__setattr__(self, 'centre', limits.vector('centre', centre, 3))
        limits.require_proportions((*self.size, *self.centre), self.spacing)

    @property
    def size(self) -> tuple[float, float, float]:
        """Sides of the box, (x, y, z), mm."""
        (nx, ny, nz), (dx, dy, dz) = self.shape, self.spacing
        return nx * dx, ny * dy, nz * dz

    @property
    def low(self) -> np.ndarray:
        """The corner where x, y and z are least, [3] mm."""
        return np.array(self.centre) - np.array(self.size) / 2

    @property
    def high(self) -> np.ndarray:
        """The corner where x, y and z are largest, [3] mm."""
        return np.array(self.centre) + np.array(self.size) / 2

    @property
    def first_voxel(self) -> np.ndarray:
        """Centre of the voxel [0, 0, 0], [3] mm."""
        return self.low + np.array(self.spacing) / 2

    @property
    def scale(self) -> float:
        """Factor from mm to lengths in the normalised frame."""
        return 2 / max(self.size)

    @property
    def half(self) -> np.ndarray:
        """Half the box's sides in the normalised frame, [3]; the largest is 1."""
        return np.array(self.size) * self.scale / 2

    def finer(self, factor: int) -> Grid:
        """The same box with every voxel divided into parts.

        Parameters
        ----------
        factor : int
            Parts along each side, at least 1.

        Returns
        -------
        Grid
            With `factor` times as many voxels along each side.

        Examples
        --------
        >>> Grid(4, 1.0).finer(2).spacing
        (0.5, 0.5, 0.5)
        """
        return replace(self, shape=[factor * n for n in self.shape], spacing=[d / factor for d in self.spacing])

    def resized(self, shape: ArrayLike) -> Grid:
        """The same box in another number of voxels.

        Parameters
        ----------
        shape : [3]
            Voxels along x, y, z.

        Returns
        -------
        Grid
            With voxels of another size.

        Examples
        --------
        >>> Grid(4, 1.0).resized((8, 4, 2)).spacing
        (0.5, 1.0, 2.0)
        """
        return replace(self, shape=shape, spacing=np.array(self.size) / np.asarray(shape))

    def slab(self, begin: int, end: int) -> Grid:
        """The slices begin <= z < end alone, at their place.

        Parameters
        ----------
        begin, end : int
            Slices along z.

        Returns
        -------
        Grid
            The slab.

        Raises
        ------
        InputError
            If there are no such slices.

        Examples
        --------
        >>> Grid(4, 1.0).slab(0, 1)
        Grid(shape=(4, 4, 1), spacing=(1.0, 1.0, 1.0), centre=(0.0, 0.0, -1.5))
        """
        (nx, ny, nz), (x, y, z) = self.shape, self.centre
        if not 0 <= begin < end <= nz:
            raise InputError(f'the volume has the slices 0 to {nz}, so none from {begin} to {end}')
        middle = z + ((begin + end) / 2 - nz / 2) * self.spacing[2]
        return replace(self, shape=(nx, ny, end - begin), centre=(x, y, middle))

    def slabs(self, thickness: int) -> list[tuple[int, int]]:
        """Divide the slices along z into slabs.

        Parameters
        ----------
        thickness : int
            Slices of a slab, at least 1.

        Returns
        -------
        list[tuple[int, int]]
            (begin, end) of each slab, from the first. The last may be thinner.

        Raises
        ------
        InputError
            For a thickness below 1.

        Examples
        --------
        >>> Grid(5, 1.0).slabs(2)
        [(0, 2), (2, 4), (4, 5)]
        """
        thickness = whole_number('the thickness of a slab, in slices,', thickness, 1)
        return [(z, min(z + thickness, self.shape[2])) for z in range(0, self.shape[2], thickness)]


class Voxels(TypedDict, total=False):
    """The grid of a scan: either itself, or by TIGRE's numbers, (x, y, z). offOrigin is 0 if it is missing."""

    grid: Grid
    nVoxel: ArrayLike
    dVoxel: ArrayLike
    offOrigin: ArrayLike


def grid_of(voxels: Mapping[str, object]) -> Grid:
    """The grid that a constructor of `Geometry` takes, by any of its names.

    Raises
    ------
    InputError
        Unless there is either `grid`, or nVoxel and dVoxel; and as `Grid` does, with the names that the caller has used.

    Examples
    --------
    >>> grid_of(dict(nVoxel=8, dVoxel=0.5)) == Grid(8, 0.5)
    True
    """
    numbers: dict[str, Any] = dict(voxels)
    names = numbers.keys()
    if not (names == {'grid'} or {'nVoxel', 'dVoxel'} <= names <= {'nVoxel', 'dVoxel', 'offOrigin'}):
        raise InputError(
            'a scan needs its voxels, either as grid=Grid(shape, spacing, centre) or as nVoxel, dVoxel and offOrigin, not '
            + (', '.join(names) if names else 'none')
        )
    if 'grid' in numbers:
        require_type('grid', numbers['grid'], Grid, 'give Grid(shape, spacing)')
        return numbers['grid']
    return Grid(
        limits.counts('nVoxel', numbers['nVoxel'], 3),
        limits.sizes('dVoxel', numbers['dVoxel'], 3),
        limits.vector('offOrigin', numbers.get('offOrigin', 0.0), 3),
    )
