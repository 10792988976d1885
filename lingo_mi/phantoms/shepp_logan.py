"""The 3D Shepp-Logan head: ten ellipsoids, with exact projections.

Geometry: the ten ellipsoids of A. C. Kak and M. Slaney, "Principles of Computerized Tomographic Imaging",
IEEE Press 1988, table 3.2, in the 3D form of the widespread `phantom3d` (M. Schabel, MATLAB File Exchange
9416). Contrast: the modified one of P. Toft, "The Radon Transform", 1996, table B.3, where details are 10 %
of the skull instead of 1 %. The sum of the ellipsoids is 0 outside, 1 in the skull and 0.2 or 0.3 in the
brain; it never leaves [0, 1], so nothing is clipped. The unit ellipsoid frame [-1, 1] is the 256 mm cube: 1
is 128 mm.

Data are voxel averages: voxels that an ellipsoid's surface crosses are sampled at 4 x 4 x 4 points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lingo_mi.geometry.base import Geometry

SIDE = 256.0  # mm

# density, semi-axes (x, y, z), centre (x, y, z), rotation about z in degrees; lengths in half sides
TABLE = np.array(
    [
        (1.0, 0.6900, 0.920, 0.810, 0, 0, 0, 0),
        (-0.8, 0.6624, 0.874, 0.780, 0, -0.0184, 0, 0),
        (-0.2, 0.1100, 0.310, 0.220, 0.22, 0, 0, -18),
        (-0.2, 0.1600, 0.410, 0.280, -0.22, 0, 0, 18),
        (0.1, 0.2100, 0.250, 0.410, 0, 0.35, -0.15, 0),
        (0.1, 0.0460, 0.046, 0.050, 0, 0.1, 0.25, 0),
        (0.1, 0.0460, 0.046, 0.050, 0, -0.1, 0.25, 0),
        (0.1, 0.0460, 0.023, 0.050, -0.08, -0.605, 0, 0),
        (0.1, 0.0230, 0.023, 0.020, 0, -0.606, 0, 0),
        (0.1, 0.0230, 0.046, 0.020, 0.06, -0.605, 0, 0),
    ]
)


@dataclass(frozen=True)
class UniformEllipsoids:
    """A sum of constant ellipsoids.

    Parameters
    ----------
    density : float64 [n]
    centre : float64 [n, 3]
        Mm.
    whiten : float64 [n, 3, 3]
        Takes an ellipsoid about its centre to the unit ball.
    """

    density: np.ndarray
    centre: np.ndarray
    whiten: np.ndarray

    def project(self, geometry: Geometry) -> np.ndarray:
        """Exact line integrals, float32 [view, v, u], density times mm (computed in float64).

        Chords are along the whole line, so source and panel must lie outside the object.
        """
        rays = geometry.rays()
        nv, nu = geometry.nDetector
        x, y = np.meshgrid(np.arange(nu) + 0.5, np.arange(nv) + 0.5)
        out = np.zeros((len(geometry), nv, nu), np.float32)
        for view in range(len(geometry)):
            origin, direction = rays.through(view, x, y)
            length = np.linalg.norm(direction, axis=-1)
            total = np.zeros((nv, nu))
            for rho, c, m in zip(self.density, self.centre, self.whiten):
                w, d = (origin - c) @ m.T, direction @ m.T
                dd = (d * d).sum(-1)
                t = (w * d).sum(-1) / dd
                closest = ((w - t[..., None] * d) ** 2).sum(-1)
                total += 2 * rho * length * np.sqrt(np.maximum(1 - closest, 0) / dd)
            out[view] = total
        return out

    @property
    def mass(self) -> float:
        """Integral of the density, mm^3."""
        return float((self.density * 4 / 3 * np.pi / np.linalg.det(self.whiten)).sum())


def ellipsoids() -> UniformEllipsoids:
    """The ten ellipsoids in the world frame, mm."""
    angle = np.radians(TABLE[:, 7])
    c, s = np.cos(angle), np.sin(angle)
    whiten = np.zeros((len(TABLE), 3, 3))
    whiten[:, 0, 0] = whiten[:, 1, 1] = c
    whiten[:, 0, 1], whiten[:, 1, 0], whiten[:, 2, 2] = s, -s, 1
    half = SIDE / 2
    whiten /= (TABLE[:, 1:4] * half)[:, :, None]
    return UniformEllipsoids(TABLE[:, 0].copy(), TABLE[:, 4:7] * half, whiten)


def build(size: int, seed: int) -> tuple[np.ndarray, float, Any]:
    """Data float32 [size]^3 in [0, 1], side in mm, and the ellipsoids (see `phantoms.make`). The seed is not
    used."""
    analytic = ellipsoids()
    h = SIDE / size
    axis = (np.arange(size) + 0.5) * h - SIDE / 2
    fine = (np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing='ij'), -1).reshape(-1, 3) + 0.5) / 4 * h - h / 2
    data = np.zeros((size,) * 3, np.float32)
    for rho, c, m in zip(analytic.density, analytic.centre, analytic.whiten):
        reach = np.linalg.norm(np.linalg.inv(m), axis=1) + h  # half sides of the bounding box
        where = tuple(slice(*np.searchsorted(axis, (a - r, a + r))) for a, r in zip(c, reach))
        x, y, z = (axis[s] - q for s, q in zip(where, c))
        radius = np.sqrt(sum((row[0] * x[:, None, None] + row[1] * y[:, None] + row[2] * z) ** 2 for row in m))
        # |M (p - c)| changes by at most |M| times half a voxel's diagonal within a voxel.
        i, j, k = np.nonzero(np.abs(radius - 1) <= np.linalg.norm(m, 2) * h * np.sqrt(3) / 2)
        cover = (radius < 1).astype(np.float32)
        edge = np.stack([x[i], y[j], z[k]], 1) @ m.T
        inside = np.zeros(len(edge), np.float32)
        for f in fine @ m.T:
            inside += ((edge + f) ** 2).sum(1) < 1
        cover[i, j, k] = inside / len(fine)
        data[where] += np.float32(rho) * cover
    return np.clip(data, 0, 1), SIDE, analytic
