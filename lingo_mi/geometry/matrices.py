"""Poses as projection matrices P [3, 4]: P (x, y, z, 1) = w (column, row, 1), the pixels' centres at whole numbers.

Lengths in mm; a matrix may have any scale and sign. A parallel beam's last row is (0, 0, 0, 1). Hartley and Zisserman,
"Multiple View Geometry in Computer Vision" (2004), section 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.limits import numbers
from lingo_mi.geometry.rays import Rays

# From continuous pixel positions, centres at (i + 1/2), to indices.
_TO_INDEX = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])

MOST = 1e100  # of a matrix's entries, whose scale says nothing


def from_matrices(
    matrices: ArrayLike,
    nDetector: tuple[int, int],
    dDetector: tuple[float, float],
    parallel: bool,
    towards: ArrayLike = (0.0, 0.0, 0.0),
) -> Rays:
    """The views whose rays the matrices [n, 3, 4] describe.

    Parameters
    ----------
    nDetector : tuple[int, int]
        (v, u) pixels.
    dDetector : tuple[float, float]
        (v, u) mm. A matrix fixes the rays of a cone beam, but not how far from the source its panel stands: it is put where the
        steps along u are dDetector[1] long. A parallel beam's steps are the matrix's own, and its panel is put beside the point
        `towards`.
    towards : array_like
        A point in front of every source.

    Raises
    ------
    InputError
        If a matrix is not a camera of that kind.
    """
    matrices, towards = numbers('projection matrices', matrices), numbers('towards', towards)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 4) or not len(matrices):
        raise InputError(f'projection matrices must be [view, 3, 4], not an array of shape {matrices.shape}')
    if not np.all(np.abs(matrices) < MOST):
        raise InputError(f'a projection matrix holds NaN or infinity, or numbers beyond {MOST:.0e}')
    P = np.linalg.inv(_TO_INDEX) @ matrices
    with np.errstate(all='ignore'):  # `checked` refuses what is not a pose
        rows = list(_parallel(P, towards) if parallel else _cone(P, towards, dDetector[1]))
    return Rays(*(np.array(column) for column in zip(*rows)), parallel=parallel).checked()


def _cone(P, towards, step):
    for view, p in enumerate(P):
        m = p[:, :3]
        if not np.linalg.cond(m / np.linalg.norm(m, axis=1, keepdims=True).clip(1e-300)) < 1e12:
            raise InputError(f'the projection matrix of view {view} does not belong to a cone beam')
        inverse = np.linalg.inv(m)
        source = -inverse @ p[:, 3]
        # w = m[2] (x - source) grows away from the source: it is positive for a point in front.
        sign = np.sign(m[2] @ (towards - source))
        if sign == 0:
            raise InputError(f'the projection matrix of view {view} puts the volume level with its source')
        inverse = inverse * sign
        scale = step / np.linalg.norm(inverse[:, 0])
        u, v, corner = (inverse * scale).T
        yield source, source + corner, u, v


def _parallel(P, towards):
    for view, p in enumerate(P):
        if np.abs(p[2, :3]).max() > 1e-9 * np.abs(p[:2, :3]).max() or p[2, 3] == 0:
            raise InputError(
                f'the projection matrix of view {view} does not belong to a parallel beam: its last row must be 0, 0, 0, 1'
            )
        p = p / p[2, 3]
        a, b = p[:2, :3]
        beam = np.cross(a, b)
        length = np.linalg.norm(beam)
        if not length > 1e-9 * np.linalg.norm(a) * np.linalg.norm(b):
            raise InputError(f'the projection matrix of view {view} has columns and rows along one direction')
        # The steps are dual to the rows in the plane across the beam.
        u, v = np.cross(b, beam) / length**2, np.cross(beam, a) / length**2
        x, y = p[:2] @ np.append(towards, 1)
        yield beam / length, towards - x * u - y * v, u, v
