"""Closed triangle meshes in NumPy: the lengths of rays in them, and the share of every voxel that they fill."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike


def add_lengths(
    image: np.ndarray, corners: np.ndarray, faces: np.ndarray, rays: Callable[..., tuple[np.ndarray, np.ndarray]]
) -> None:
    """Adds to image [nv, nu] the signed distances along rays to triangles.

    corners  [n, 3, 2], pixel positions; faces [n, 3, 3], world; rays(x, y) -> origins, directions
    A pixel centre on an edge belongs to one of the two triangles only: half-open crossing tests in the panel.
    """
    nv, nu = image.shape
    low = np.maximum(np.ceil(corners.min(1) - 0.5), 0).astype(int)
    high = np.minimum(np.floor(corners.max(1) - 0.5), (nu - 1, nv - 1)).astype(int) + 1
    for c, f, (x0, y0), (x1, y1) in zip(corners, faces, low, high):
        if x0 >= x1 or y0 >= y1:
            continue
        x, y = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
        inside = np.zeros(x.shape, bool)
        for (ax, ay), (bx, by) in zip(c, np.roll(c, -1, 0)):
            # Sorted by height, so that both triangles of an edge compute the same crossing bit for bit.
            (px, py), (qx, qy) = sorted(((ax, ay), (bx, by)), key=lambda p: (p[1], p[0]))
            if py < qy:
                inside ^= (py <= y) & (y < qy) & (x < px + (y - py) * ((qx - px) / (qy - py)))
        if inside.any():
            o, d = rays(x[inside], y[inside])
            normal = np.cross(f[1] - f[0], f[2] - f[0])
            along = d @ normal
            t = ((f[0] - o) @ normal) / along * np.linalg.norm(d, axis=-1)
            part = image[y0:y1, x0:x1]
            part[inside] += np.sign(along) * t


def voxelize_triangles(
    triangles: np.ndarray, low: ArrayLike, step: ArrayLike, shape: tuple[int, int, int]
) -> np.ndarray:
    """The share of every voxel that lies inside closed meshes of triangles [n, 3, 3]: float32 [x, y, z].

    low [3], step [3]   corner of the grid and voxel size, the unit of the triangles

    Columns along z are cut by the mesh, 4 x 4 a voxel; between two crossings a voxel is covered by the length it shares
    with the column, once for each part of the mesh that it lies in: if parts overlap, shares add up to more than 1. Which way
    round the mesh is as a whole plays no part.
    """
    low, step, fine = np.asarray(low, float), np.asarray(step, float), 4
    nx, ny, nz = shape
    edges = low[2] + np.arange(nz + 1) * step[2]
    start = min(low[2], triangles[..., 2].min()) - 1
    covered = np.zeros((nx, ny, nz + 1))
    cell = step[:2] / fine
    corners = (triangles[:, :, :2] - low[:2]) / cell
    first = np.maximum(np.ceil(corners.min(1) - 0.5), 0).astype(int)
    last = np.minimum(np.floor(corners.max(1) - 0.5), (nx * fine - 1, ny * fine - 1)).astype(int) + 1
    for face, c, (x0, y0), (x1, y1) in zip(triangles, corners, first, last):
        if x0 >= x1 or y0 >= y1:
            continue
        image = np.zeros((y1 - y0, x1 - x0))
        add_lengths(
            image,
            (c - (x0, y0))[None],
            face[None],
            lambda x, y, x0=x0, y0=y0: (
                np.stack([(x + x0) * cell[0] + low[0], (y + y0) * cell[1] + low[1], 0 * x + start], -1),
                np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3)),
            ),
        )
        j, i = np.nonzero(image)
        sign, z = np.sign(image[j, i]), np.abs(image[j, i]) + start
        # The length of the column below each voxel edge that lies below the crossing.
        below = np.maximum(np.minimum(edges, z[:, None]) - edges[0], 0)
        np.add.at(covered, ((i + x0) // fine, (j + y0) // fine), sign[:, None] * below)
    data = np.diff(covered, axis=2) / (step[2] * fine * fine)
    data *= np.sign(data.sum())
    data[np.abs(data) < 1e-9] = 0
    data[np.abs(data - 1) < 1e-9] = 1
    return np.maximum(data, 0).astype(np.float32)
