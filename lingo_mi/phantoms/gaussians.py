"""A random cloud of Gaussians, the exact reference for tests of projectors, voxelizers and fits.

    sigma(x) = sum_i rho_i exp(-1/2 |W_i (x - p_i)|^2),   W_i = diag(1 / s_i) R_i^T

Data are values at voxel centres, not averages, cut off at 6 sigma (a relative 1.5e-8). Projections are the
closed form along whole lines, in float64:

    integral along o + t D  =  rho sqrt(2 pi) |D| / |d| exp(-1/2 |w x d|^2 / |d|^2),   w = W (o - p),  d = W D
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry

SIDE = 256.0  # mm
CUT = 6.0  # sigma, of the voxels
_WINDOW = 8.0  # sigma, of the projections


@dataclass(frozen=True)
class Cloud:
    """Gaussians in the world frame.

    Parameters
    ----------
    centres : float64 [n, 3]
        Mm.
    scales : float64 [n, 3]
        Mm.
    quaternions : float64 [n, 4]
        Unit, (x, y, z, w).
    density : float64 [n]
        The value at the centre.
    """

    centres: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    density: np.ndarray

    def __len__(self) -> int:
        return len(self.density)

    @property
    def whiten(self) -> np.ndarray:
        """W, float64 [n, 3, 3]."""
        return np.swapaxes(Rotation.from_quat(self.quaternions).as_matrix(), 1, 2) / self.scales[:, :, None]

    @property
    def mass(self) -> float:
        """Integral of the density, mm^3."""
        return float((self.density * (2 * np.pi) ** 1.5 * self.scales.prod(1)).sum())

    def voxels(self, size: int, side: float = SIDE) -> np.ndarray:
        """Values at the voxel centres of a centred cube, float32 [size]^3."""
        h = side / size
        axis = (np.arange(size) + 0.5) * h - side / 2
        data = np.zeros((size,) * 3)
        reach = CUT * np.sqrt((np.linalg.inv(self.whiten) ** 2).sum(2))  # half sides of the 6 sigma boxes
        for p, r, w, rho in zip(self.centres, reach, self.whiten, self.density):
            where = tuple(slice(*np.searchsorted(axis, (a - b, a + b))) for a, b in zip(p, r))
            x, y, z = (axis[s] - c for s, c in zip(where, p))
            (a, d, e), (_, b, f), (_, _, c) = w.T @ w
            q = (a * x * x)[:, None, None] + (b * y * y)[:, None] + c * z * z
            q += 2 * (d * x[:, None, None] * y[:, None] + e * x[:, None, None] * z + f * y[:, None] * z)
            data[where] += rho * np.where(q <= CUT * CUT, np.exp(-0.5 * q), 0)
        return data.astype(np.float32)

    def project(self, geometry: Geometry) -> np.ndarray:
        """Exact line integrals, float32 [view, v, u], density times mm (computed in float64).

        A Gaussian is evaluated on the bounding box of its 8 sigma outline; outside, it is below 2e-14 of its peak.

        Raises
        ------
        InputError
            If the source lies in or beside a Gaussian, which then has no outline on the panel.
        """
        rays, whiten = geometry.rays(), self.whiten
        spread = np.linalg.inv(np.swapaxes(whiten, 1, 2) @ whiten)
        panel = geometry.nDetector[::-1]
        out = np.zeros((len(geometry), *geometry.nDetector))
        for view in range(len(geometry)):
            centre, low, high = _outlines(self.centres, spread, rays, view)
            low = np.clip(np.floor(low), 0, panel).astype(int)
            high = np.clip(np.ceil(high), 0, panel).astype(int)
            for i in np.flatnonzero((low < high).all(1)):
                (x0, y0), (x1, y1) = low[i], high[i]
                x, y = np.arange(x0, x1) + 0.5 - centre[i, 0], np.arange(y0, y1) + 0.5 - centre[i, 1]
                shape = _footprint(x, y, rays, view, centre[i], self.centres[i], whiten[i])
                out[view, y0:y1, x0:x1] += self.density[i] * shape
        return out.astype(np.float32)


def _outlines(centres, spread, rays, view):
    """Pixel positions [n, 2] of the projected centres, and the corners of the boxes around the outlines."""
    source, corner, u, v = (a[view] for a in (rays.source, rays.corner, rays.u, rays.v))
    if rays.parallel:
        m = np.linalg.inv(np.stack([u, v, -source], 1))[:2]
        centre = (centres - corner) @ m.T
        half = _WINDOW * np.sqrt(np.einsum('ij,njk,ik->ni', m, spread, m))
        return centre, centre - half, centre + half
    m = np.linalg.inv(np.stack([u, v, corner - source], 1))
    h = (centres - source) @ m.T
    # The dual conic of an ellipsoid's outline, in homogeneous pixel coordinates.
    c = _WINDOW**2 * m @ spread @ m.T - h[:, :, None] * h[:, None, :]
    if (c[:, 2, 2] >= 0).any() or (h[:, 2] <= 0).any():
        raise InputError(f'the source of view {view} lies in or behind the cloud: enlarge DSO')
    third = c[:, 2, 2][:, None]
    middle = c[:, :2, 2] / third
    half = np.sqrt(middle**2 - np.diagonal(c, axis1=1, axis2=2)[:, :2] / third)
    return h[:, :2] / h[:, 2:], middle - half, middle + half


def _footprint(x, y, rays, view, pixel, centre, whiten):
    """Line integrals [y, x] of a Gaussian of density 1 at pixel offsets x, y from its projected centre."""
    origin, ray = rays.through(view, *pixel)
    a, b = whiten @ rays.u[view], whiten @ rays.v[view]
    d = whiten @ ray
    # w x d vanishes at the projected centre, and is linear in x and y.
    if rays.parallel:
        na, nb = np.cross(a, d), np.cross(b, d)
        ray2, d2 = ray @ ray, d @ d
    else:
        w = whiten @ (origin - centre)
        na, nb = np.cross(w, a), np.cross(w, b)
        ray2 = _square(x, y, rays.u[view], rays.v[view], ray)
        d2 = _square(x, y, a, b, d)
    return np.sqrt(2 * np.pi * ray2 / d2) * np.exp(-0.5 * _square(x, y, na, nb, np.zeros(3)) / d2)


def _square(x, y, a, b, c):
    """|x a + y b + c|^2 on the grid [y, x]."""
    return (
        x * x * (a @ a)
        + 2 * x * (a @ c)
        + (c @ c)
        + (2 * y * (b @ c) + y * y * (b @ b))[:, None]
        + (2 * (a @ b) * y)[:, None] * x
    )


def cloud(n: int = 2000, seed: int = 0) -> Cloud:
    """n random Gaussians in a ball of 80 mm radius: balls, needles and pancakes with scales of 1.2 to 9 mm.

    Densities fall with n, so that the sum stays below 1.

    Raises
    ------
    InputError
        Unless n is at least 1.
    """
    if n < 1:
        raise InputError(f'a cloud needs at least one Gaussian, not {n}')
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centres = direction * 80 * rng.random((n, 1)) ** (1 / 2.4)
    scales = 1.2 * np.exp(rng.uniform(0, np.log(7.5), (n, 3)))
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    density = rng.uniform(0.2, 1, n) * 0.12 * min(1.0, (2000 / n) ** 0.8)
    return Cloud(centres, scales, quaternions, density)


def build(size: int, seed: int) -> tuple[np.ndarray, float, Any]:
    """Data float32 [size]^3, side in mm, and the cloud (see `phantoms.make`)."""
    analytic = cloud(seed=seed)
    return analytic.voxels(size), SIDE, analytic
