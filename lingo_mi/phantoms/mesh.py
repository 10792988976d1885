"""A welding-neck flange as a watertight mesh: sharp edges, flat faces, metal.

The plate has eight bolt holes. In place of a ninth it has a dowel hole a third as wide, which breaks the
symmetry. The flange is tilted against all axes. Density is 1 inside, 0 outside. Data are voxel averages from
4 x 4 columns per voxel, exact along the third axis; projections are exact chords through the mesh. For
Mitsuba's `ply` and `obj` shapes:

    flange().export('flange.ply')
    bolts().export('bolts.ply')       # eight that fit its holes; not part of the phantom
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.triangles import add_lengths, voxelize_triangles
from lingo_mi.phantoms.solids import yaw_pitch_roll

SIDE = 256.0  # mm
BORE, NECK, ROOT, RIM = 32.0, 40.0, 54.0, 96.0  # radii, mm
BOTTOM, PLATE, TOP = -38.0, -14.0, 44.0  # heights of the faces, mm
BOLTS, BOLT_CIRCLE, BOLT, DOWEL = 9, 76.0, 10.0, 3.5  # count, radius of their circle, radii of the holes
SHANK, HEAD, LENGTH = 9.5, 15.0, 10.0  # a bolt's radii and the height of its head
GAP = 0.25  # between head and plate, so that the parts share no face
_ARC = 12  # mesh steps along a bolt's sector
_FAN = 36  # vertices around a hole


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
        triangles += [
            _strip(lift(outer, PLATE), lift(inner, PLATE)),
            _strip(lift(inner, BOTTOM), lift(outer, BOTTOM)),
            _strip(lift(inner, PLATE), lift(inner, BOTTOM)),
        ]
    # The profile from the rim's lower edge over the rim, and from the neck over the bore to the bottom.
    rim = [(RIM, BOTTOM), (RIM, PLATE)]
    neck = [(ROOT, PLATE), (NECK, TOP), (BORE, TOP), (BORE, BOTTOM), (ROOT, BOTTOM)]
    for line in (rim, neck):
        triangles += [_strip(ring(*p), ring(*q)) for p, q in zip(line[:-1], line[1:])]
    return _tilted(np.concatenate(triangles))


def bolts() -> trimesh.Trimesh:
    """Hexagon bolts through the eight bolt holes in the world frame, mm: one mesh of closed parts, outward normals."""
    bottom, top = BOTTOM - 4, PLATE + GAP
    # Radius, height and whether the ring is a hexagon, from the axis at the lower end to the axis at the upper one.
    profile = [
        (0.0, bottom, False),
        (SHANK, bottom, False),
        (SHANK, top, False),
        (HEAD, top, True),
        (HEAD, top + LENGTH, True),
        (0.0, top + LENGTH, True),
    ]
    angle = 2 * np.pi * np.arange(_FAN) / _FAN
    hexagon = np.cos(np.pi / 6) / np.cos(angle % (np.pi / 3) - np.pi / 6)
    triangles = []
    for i in range(1, BOLTS):  # the place of bolt 0 is the dowel's
        turn = 2 * np.pi * i / BOLTS
        axis = BOLT_CIRCLE * np.array([np.cos(turn), np.sin(turn), 0])

        def ring(radius, z, hexagonal):
            r = radius * (hexagon if hexagonal else np.ones(_FAN))
            return axis + np.stack([r * np.cos(angle), r * np.sin(angle), np.full(_FAN, z)], 1)

        triangles += [_strip(ring(*p), ring(*q)) for p, q in zip(profile[:-1], profile[1:])]
    return _tilted(np.concatenate(triangles))


def _tilted(triangles):
    """A closed mesh of triangles [n, 3, 3], tilted against all axes; those without area are dropped."""
    points = triangles.reshape(-1, 3) @ yaw_pitch_roll(25, 32, 14)
    # Vertices of neighbours agree to rounding; merge them to make the mesh closed.
    points, index = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, 1)).all(1)
    return trimesh.Trimesh(points, faces[distinct], process=False)


@dataclass(frozen=True)
class Mesh:
    """A closed mesh of density 1 with exact projections."""

    mesh: trimesh.Trimesh

    def project(self, geometry: Geometry) -> np.ndarray:
        """Exact chord lengths, float32 [view, v, u], mm.

        The chord is the signed sum of the distances to all faces a ray crosses, so every triangle is drawn on the panel once. The
        whole object must lie between source and panel.

        Raises
        ------
        InputError
            If part of it is behind the source.
        """
        rays, faces = geometry.rays(), self.mesh.faces
        nv, nu = geometry.nDetector
        out = np.zeros((len(geometry), nv, nu))
        for view in range(len(geometry)):
            corners = np.stack(rays.project(self.mesh.vertices, view), -1)[faces]
            if not np.isfinite(corners).all():
                raise InputError(f'part of the mesh lies behind the source of view {view}: enlarge DSO')
            add_lengths(out[view], corners, self.mesh.triangles, lambda x, y, view=view: rays.through(view, x, y))
        return out.astype(np.float32)


def build(size: int, seed: int) -> tuple[np.ndarray, float, Any]:
    """Data float32 [size]^3 in [0, 1], side in mm, and the mesh (see `phantoms.make`). The seed is not
    used."""
    analytic = Mesh(flange())
    step = SIDE / size
    return voxelize_triangles(analytic.mesh.triangles, [-SIDE / 2] * 3, [step] * 3, (size, size, size)), SIDE, analytic
