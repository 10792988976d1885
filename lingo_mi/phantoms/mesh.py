"""A welding-neck flange as a watertight mesh: sharp edges, flat faces, metal.

The plate has eight bolt holes and a dowel hole a third as wide in the place of a ninth, which breaks its
symmetry. The flange is tilted against all axes. Density is 1 inside, 0 outside. Data are voxel averages from
4 x 4 columns a voxel, exact along the third axis; projections are exact chords through the mesh. For
Mitsuba's `ply` and `obj` shapes:

    flange().export('flange.ply')
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from ..errors import InputError
from ..geometry import Geometry
from .solids import rotation

SIDE = 256.                                         # mm
BORE, NECK, ROOT, RIM = 32., 40., 54., 96.          # radii, mm
BOTTOM, PLATE, TOP = -38., -14., 44.                # heights of the faces, mm
BOLTS, BOLT_CIRCLE, BOLT, DOWEL = 9, 76., 10., 3.5  # count, radius of their circle, radii of the holes
_ARC = 12                                           # mesh steps along a bolt's sector
_FAN = 36                                           # vertices around a hole


def _outline():
    """A sector's outline around the bolt at angle 0: [_FAN, 2], anticlockwise, shared with its neighbours and
    the neck."""
    half = np.pi / BOLTS
    arc = np.linspace(-half, half, _ARC + 1)
    side = np.linspace(ROOT, RIM, (_FAN - 2 * _ARC) // 2 + 1)
    r = np.concatenate([np.full(_ARC, RIM), side[:0:-1], np.full(_ARC, ROOT), side[:-1]])
    a = np.concatenate([arc[:-1], np.full(len(side) - 1, half), arc[:0:-1], np.full(len(side) - 1, -half)])
    return np.stack([r * np.cos(a), r * np.sin(a)], 1)


def _strip(lower, upper, closed=True):
    """Two triangles between each pair of neighbours on two rows of points [n, 3]."""
    a, b = (lower, np.roll(lower, -1, 0)), (upper, np.roll(upper, -1, 0))
    n = len(lower) if closed else len(lower) - 1
    return np.concatenate([np.stack([a[0], a[1], b[1]], 1)[:n], np.stack([a[0], b[1], b[0]], 1)[:n]])


def flange() -> trimesh.Trimesh:
    """The flange in the world frame, mm: closed, outward normals."""
    triangles = []

    def ring(radius, z):
        a = np.pi * 2 * np.arange(BOLTS * _ARC) / (BOLTS * _ARC) - np.pi / BOLTS
        return np.stack([radius * np.cos(a), radius * np.sin(a), np.full(len(a), z)], 1)

    def lift(points, z):
        return np.column_stack([points, np.full(len(points), z)])

    outline = _outline()
    for i in range(BOLTS):
        hole = DOWEL if i == 0 else BOLT
        turn = 2 * np.pi * i / BOLTS
        matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        spoke = outline - [BOLT_CIRCLE, 0]
        rim = spoke / np.linalg.norm(spoke, axis=1, keepdims=True) * hole + [BOLT_CIRCLE, 0]
        outer, inner = outline @ matrix, rim @ matrix
        triangles += [_strip(lift(outer, PLATE), lift(inner, PLATE)),
                      _strip(lift(inner, BOTTOM), lift(outer, BOTTOM)),
                      _strip(lift(inner, PLATE), lift(inner, BOTTOM))]
    # The profile from the rim's lower edge over the rim, and from the neck over the bore to the bottom.
    rim = [(RIM, BOTTOM), (RIM, PLATE)]
    neck = [(ROOT, PLATE), (NECK, TOP), (BORE, TOP), (BORE, BOTTOM), (ROOT, BOTTOM)]
    for line in (rim, neck):
        triangles += [_strip(ring(*p), ring(*q)) for p, q in zip(line[:-1], line[1:])]
    points = np.concatenate(triangles).reshape(-1, 3) @ rotation(25, 32, 14)
    # Vertices of neighbours agree to rounding; merge them to make the mesh closed.
    points, index = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    return trimesh.Trimesh(points, index.reshape(-1, 3), process=False)


@dataclass(frozen=True)
class Mesh:
    """A closed mesh of density 1 with exact projections."""

    mesh: trimesh.Trimesh

    def project(self, geometry: Geometry) -> np.ndarray:
        """Exact chord lengths, float32 [view, v, u], mm.

        The chord is the signed sum of the distances to all faces a ray crosses, so every triangle is drawn on
        the panel once. The whole object must lie between source and panel.
        Raises InputError if part of it is behind the source.
        """
        frames, faces = geometry.frames(), self.mesh.faces
        nv, nu = geometry.nDetector
        out = np.zeros((len(geometry), nv, nu))
        for view in range(len(geometry)):
            corners = np.stack(frames.project(self.mesh.vertices, view), -1)[faces]
            if not np.isfinite(corners).all():
                raise InputError(f'part of the mesh lies behind the source of view {view}: enlarge DSO')
            _draw(out[view], corners, self.mesh.triangles, lambda x, y, view=view: frames.rays(view, x, y))
        return out.astype(np.float32)


def _draw(image, corners, faces, rays):
    """Adds to image [nv, nu] the signed distances along rays to triangles.

    corners  [n, 3, 2], pixel positions; faces [n, 3, 3], world; rays(x, y) -> origins, directions
    A pixel centre on an edge belongs to one of the two triangles only: half-open crossing tests in the panel.
    """
    nv, nu = image.shape
    low = np.maximum(np.ceil(corners.min(1) - .5), 0).astype(int)
    high = np.minimum(np.floor(corners.max(1) - .5), (nu - 1, nv - 1)).astype(int) + 1
    for c, f, (x0, y0), (x1, y1) in zip(corners, faces, low, high):
        if x0 >= x1 or y0 >= y1:
            continue
        x, y = np.meshgrid(np.arange(x0, x1) + .5, np.arange(y0, y1) + .5)
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


def build(size: int, seed: int):
    """Data float32 [size]^3 in [0, 1], side in mm, and the mesh (see `phantoms.make`). The seed plays no
    part.

    Columns along z are cut by the mesh; between two crossings a voxel is covered by the length it shares with
    the column.
    """
    analytic = Mesh(flange())
    h, fine = SIDE / size, 4
    triangles = analytic.mesh.triangles
    edges = (np.arange(size + 1) - size / 2) * h
    covered = np.zeros((size, size, size + 1))
    corners = (triangles[:, :, :2] + SIDE / 2) / (h / fine)
    n = size * fine
    low = np.maximum(np.ceil(corners.min(1) - .5), 0).astype(int)
    high = np.minimum(np.floor(corners.max(1) - .5), n - 1).astype(int) + 1
    for face, c, (x0, y0), (x1, y1) in zip(triangles, corners, low, high):
        if x0 >= x1 or y0 >= y1:
            continue
        image = np.zeros((y1 - y0, x1 - x0))
        _draw(image, (c - (x0, y0))[None], face[None], lambda x, y, x0=x0, y0=y0: (
            np.stack([(x + x0) * h / fine - SIDE / 2, (y + y0) * h / fine - SIDE / 2, 0 * x - SIDE], -1),
            np.broadcast_to([0., 0., 1.], (len(x), 3))))
        j, i = np.nonzero(image)
        sign, z = np.sign(image[j, i]), np.abs(image[j, i]) - SIDE
        # The length of the column below each voxel edge that lies below the crossing.
        below = np.minimum(edges, z[:, None]) - edges[0]
        np.add.at(covered, ((i + x0) // fine, (j + y0) // fine), sign[:, None] * below)
    data = np.diff(covered, axis=2) / (h * fine * fine)
    data[np.abs(data) < 1e-9] = 0
    return np.clip(data, 0, 1).astype(np.float32), SIDE, analytic
