"""Mask-guided voxel filtering (paper, section III-A): which voxel centres lie in the masks of all views.

Points that project outside an image are removed, as in the paper's text, not moved to its border (as `clip`
would do). Pure NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.rays import Rays
from lingo_mi.lingo.masks import Masks

CHUNK = 1 << 15  # points projected at once, so that they stay in the cache
BLOCK = 8  # cells along the side of a block, which is tested as a whole


def voxel_centres(grid: Sequence[int] | np.ndarray, half: ArrayLike, index: np.ndarray | None = None) -> np.ndarray:
    """Centres [N, 3] of the cells `index` (flat, z fastest; default all) of a grid over [-half, half].

    Parameters
    ----------
    grid : Sequence[int] or ndarray
        Cells (x, y, z).
    half : array_like
        Half the volume's sides in the normalised frame, [3].
    """
    cells, half = np.asarray(grid, int), np.asarray(half, float)
    index = np.arange(cells.prod()) if index is None else index
    ijk = np.stack(np.unravel_index(index, tuple(cells)), -1)
    return (ijk + 0.5) * (2 * half / cells) - half


def pixels(matrix: np.ndarray, points: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """P^I = floor(clip(M P)): flat pixel indices [N], and whether each point projects into the image, [N].

    Points outside get the index 0. Pixel (i, j) covers [i, i + 1) x [j, j + 1) of the continuous pixel
    positions.

    Parameters
    ----------
    matrix : ndarray [3, 4]
        See `camera_matrices`.
    points : ndarray [3, N]
    shape : tuple[int, int]
        (v, u) of the image.
    """
    x, y, w = matrix[:, :3] @ points + matrix[:, 3:]
    with np.errstate(divide='ignore', invalid='ignore'):
        x /= w
        y /= w
        inside = (w > 0) & (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
        index = y.astype(np.int32) * shape[1] + x.astype(np.int32)
    return np.where(inside, index, 0), inside


def _candidates(matrices, low_images, grid, half, misses, outside):
    """Flat indices, sorted, of the cells that may be valid: all but blocks of cells that are certainly invalid.

    A block is the convex hull of its corners, so its cells project into the rectangle around the projected
    corners (in front of the source). If this contains no pixel of the low mask, the view misses every cell of
    the block.
    """
    shape = low_images[0].shape
    ends = [np.minimum(np.arange(0, n + BLOCK, BLOCK), n) for n in grid]
    ends = [e[: np.argmax(e) + 1] for e in ends]
    blocks = tuple(len(e) - 1 for e in ends)
    axes = [e * (2 * h / n) - h for e, h, n in zip(ends, half, grid)]
    lattice = np.stack(np.meshgrid(*axes, indexing='ij'))
    missed = np.zeros(blocks, np.int32)
    for matrix, image in zip(matrices, low_images):
        h = np.tensordot(matrix[:, :3], lattice, 1) + matrix[:, 3, None, None, None]
        in_front = _over_corners(np.minimum, h[2]) > 0
        with np.errstate(divide='ignore', invalid='ignore'):
            position = np.nan_to_num(h[:2] / h[2], posinf=0, neginf=0)
        # One pixel more on each side guards against rounding.
        first = [_over_corners(np.minimum, q) - 1 for q in position]
        last = [_over_corners(np.maximum, q) + 2 for q in position]
        x0, x1, y0, y1 = (
            np.clip(q, 0, shape[1 - axis]).astype(np.int32) for axis in (0, 1) for q in (first[axis], last[axis])
        )
        table = np.zeros((shape[0] + 1, shape[1] + 1), np.int32)  # pixels of the mask above and to the left
        np.cumsum(np.cumsum(image, 0, dtype=np.int32), 1, out=table[1:, 1:])
        empty = in_front & (table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] == 0)
        if outside == 'ignore':
            empty &= (first[0] >= 0) & (first[1] >= 0) & (last[0] <= shape[1]) & (last[1] <= shape[0])
        missed += empty
    keep = missed <= misses
    for axis, e in enumerate(ends):
        keep = np.repeat(keep, np.diff(e), axis)
    return np.flatnonzero(keep)


def _over_corners(function, values):
    """The minimum or maximum over the eight corners of every block."""
    for axis in range(3):
        n = values.shape[axis]
        values = function(values.take(range(n - 1), axis), values.take(range(1, n), axis))
    return values


def valid_voxels(
    rays: Rays,
    masks: Masks,
    grid: Sequence[int] | np.ndarray,
    half: ArrayLike,
    misses: int = 0,
    outside: str = 'invalid',
) -> tuple[np.ndarray, np.ndarray]:
    """The intersections of all views: flat cell indices (z fastest) of the low and the high valid set, sorted.

    A view is left out for cells that project to its invalid pixels.

    Parameters
    ----------
    rays : Rays
        n views in the normalised frame.
    masks : Masks
        Masks of the same n views.
    grid : Sequence[int] or ndarray
        Cells (x, y, z) over [-half, half].
    misses : int
        Number of views in which a valid cell may lie outside the mask (paper: 0).
    outside : str
        For a cell that projects outside a view's image: 'invalid' counts as a miss (paper); 'ignore' leaves the view out, for
        truncated scans (a cell outside all views is still invalid).

    Raises
    ------
    InputError
        For another value of `outside`, or a number of masks that is not the number of views.
    """
    if outside not in ('invalid', 'ignore'):
        raise InputError(f"outside must be 'invalid' or 'ignore', not {outside!r}")
    if len(masks.low) != len(rays):
        raise InputError(f'{len(masks.low)} masks were given for {len(rays)} views: one a view is needed')
    shape = masks.low.shape[1:]
    low_images, high_images = masks.low.reshape(len(rays), -1), masks.high.reshape(len(rays), -1)
    valid = None if masks.valid is None else masks.valid.reshape(len(rays), -1)
    matrices = camera_matrices(rays)
    low, high = [], []
    total = int(np.prod(grid))
    if total <= CHUNK:
        cells = np.arange(total)
    else:
        # With negative thresholds, or low_factor above 1, high is not a part of low. Invalid pixels exclude no cell.
        possible = masks.low | masks.high
        if masks.valid is not None:
            possible |= ~masks.valid
        cells = _candidates(matrices, possible, grid, half, misses, outside)
    for start in range(0, len(cells), CHUNK):
        alive = cells[start : start + CHUNK]
        points = np.ascontiguousarray(voxel_centres(grid, half, alive).T)
        missed_low, missed_high, seen = (np.zeros(len(alive), np.int32) for _ in range(3))
        for view, (matrix, low_image, high_image) in enumerate(zip(matrices, low_images, high_images)):
            index, inside = pixels(matrix, points, shape)
            counts = inside if outside == 'ignore' else True
            measured = inside
            if valid is not None:
                measured = inside & valid[view][index]
                counts = counts & (measured | ~inside)
            missed_low += counts & ~(low_image[index] & inside)
            missed_high += counts & ~(high_image[index] & inside)
            seen += measured
            keep = (missed_low <= misses) | (missed_high <= misses)
            if np.count_nonzero(keep) < 0.9 * len(keep):  # cells that left both sets stay out
                alive, points, missed_low, missed_high, seen = (
                    a[..., keep] for a in (alive, points, missed_low, missed_high, seen)
                )
        low.append(alive[(missed_low <= misses) & (seen > 0)])
        high.append(alive[(missed_high <= misses) & (seen > 0)])
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *low]), np.concatenate([none, *high])
