"""Line integrals of a cloud of Gaussians and their derivatives in float64 NumPy: the reference for errors.

With W = diag(1/s) R^T, w = W (p - o), d = W D, m = w.d / |d|^2 and r = w - m d, from a ray's nearest point to the centre,

    integral = rho sqrt(2 pi) |D| / |d| exp(-|r|^2 / 2),    d ln(integral) = -r . dw + (m r - d / |d|^2) . dd

Independent of the projector: the general form on explicit rays, without footprints, differentiated by hand. Integrals are along
the whole line. The module `oracle` uses finite differences, Gaussian by Gaussian. It also has integrals that begin at the
source, and explains why both are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lingo_mi.geometry.rays import Rays

NAMES = {'centre': 3, 'scale': 3, 'rotation': 4, 'density': 1}
REACH = 9.0  # standard deviations: beyond, a Gaussian is below 3e-18 of its peak


def image_and_gradients(
    gaussians: Sequence[np.ndarray],
    rays: Rays,
    shape: tuple[int, int],
    weights: np.ndarray | None = None,
    order: int = 0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """One view of a cloud, float64 [v, u]; and derivatives of sum(weights * image) by name, float64 [N, ...].

    The source must be farther from the Gaussians than their reach.

    Parameters
    ----------
    gaussians : Sequence[ndarray]
        Centre, scale [N, 3]; rotation [N, 4], quaternions (x, y, z, w) of any length; density [N].
    rays : Rays
        The view is its first one.
    shape : tuple[int, int]
        Shape of the image, (v, u).
    weights : ndarray [v, u] or None
        Or None for no derivatives: none in the dictionary.
    order : int
        0 for rays through the pixel centres; n for the mean over the pixels by n x n Gauss-Legendre points.
    """
    gaussians = [np.asarray(x, float) for x in gaussians]
    image = np.zeros(shape)
    count = len(gaussians[3])
    gradients = {name: np.zeros((count, size)) for name, size in NAMES.items()}
    at, weight = np.polynomial.legendre.leggauss(order) if order else (np.zeros(1), np.full(1, 2.0))
    # (x, y) in the pixel and the share of every ray
    samples = [((a + 1) / 2, (b + 1) / 2, u * v / 4) for a, u in zip(at, weight) for b, v in zip(at, weight)]
    low, high = _boxes(gaussians[0], gaussians[1].max(1) * REACH, rays, shape)
    for i in np.flatnonzero((low < high).all(1)):
        rows, columns = (np.arange(*ends) for ends in zip(low[i], high[i]))
        box = np.ix_(rows, columns)
        g = weights[box] if weights is not None else None
        gaussian = tuple(x[i] for x in gaussians)
        for x, y, share in samples:
            start, direction = rays.through(0, *np.broadcast_arrays(columns + x, rows[:, None] + y))
            value, by_row = _gaussian(gaussian, start, direction, g)
            image[box] += share * value
            if by_row is not None:
                for name, row in zip(NAMES, by_row):
                    gradients[name][i] += share * row
    gradients['density'] = gradients['density'][:, 0]
    return image, gradients if weights is not None else {}


def rays_and_gradients(
    gaussians: Sequence[np.ndarray], start: np.ndarray, direction: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Line integrals of a cloud along rays [M, 3], float64 [M], and derivatives as `image_and_gradients` gives them."""
    gaussians = [np.asarray(x, float) for x in gaussians]
    total: Any = 0.0
    rows = []
    for gaussian in zip(*gaussians):
        value, row = _gaussian(gaussian, start, direction, weights)
        total = total + value
        rows.append(row)
    return total, {name: np.array(column) for name, column in zip(NAMES, zip(*rows))}


def _boxes(centre, radius, rays, shape):
    """Pixels [low, high), each [N, 2] as (v, u), of images of balls."""
    x, y = rays.project(centre, 0)
    normal = np.cross(rays.u[0], rays.v[0])
    if rays.parallel:
        stretch = np.ones(len(centre))
        slant = np.linalg.norm(normal) / abs(normal @ rays.source[0])
    else:
        axis, to = rays.corner[0] - rays.source[0], centre - rays.source[0]
        depth = to @ normal
        near = np.abs(depth) - radius * np.linalg.norm(normal)
        # Generous: the ball's nearest plane, and the obliqueness of the ray.
        stretch = abs(axis @ normal) / near
        slant = np.linalg.norm(to, axis=1) * np.linalg.norm(normal) / np.abs(depth)
    pixel = min(np.linalg.norm(rays.u[0]), np.linalg.norm(rays.v[0]))
    half = radius * stretch * slant**2 / pixel
    middle = np.stack([y, x], 1)
    low, high = np.floor(middle - half[:, None]), np.ceil(middle + half[:, None]) + 1
    return np.clip(low, 0, shape).astype(int), np.clip(high, 0, shape).astype(int)


def _gaussian(gaussian, start, direction, weights):
    """Integrals [...] of one Gaussian along rays [..., 3], and rows of derivatives in the order of NAMES."""
    centre, scale, rotation, density = gaussian
    R = Rotation.from_quat(rotation).as_matrix()
    W = R.T / scale[:, None]
    to = centre - start
    w, d = to @ W.T, direction @ W.T
    dd = (d * d).sum(-1, keepdims=True)
    m = (w * d).sum(-1, keepdims=True) / dd
    r = w - m * d
    shape = np.sqrt(2 * np.pi / dd[..., 0]) * np.linalg.norm(direction, axis=-1) * np.exp(-0.5 * (r * r).sum(-1))
    if weights is None:
        return density * shape, None
    g = (weights * density * shape)[..., None]
    by_w, by_d = (-g * r).reshape(-1, 3), (g * (m * r - d / dd)).reshape(-1, 3)
    A = by_w.T @ to.reshape(-1, 3) + by_d.T @ direction.reshape(-1, 3)  # by W
    by_scale = -(A * W).sum(1) / scale
    return density * shape, (
        by_w.sum(0) @ W,
        by_scale,
        _by_quaternion(rotation, (A / scale[:, None]).T),
        (weights * shape).sum(),
    )


def _by_quaternion(q, by_R):
    """The derivative by a quaternion of any length from that by its rotation matrix."""
    length = np.linalg.norm(q)
    x, y, z, w = q / length
    parts = np.array(
        [
            [[0, y, z], [y, -2 * x, -w], [z, w, -2 * x]],
            [[-2 * y, x, w], [x, 0, z], [-w, z, -2 * y]],
            [[-2 * z, -w, x], [w, -2 * z, y], [x, y, 0]],
            [[0, -z, y], [z, 0, -x], [-y, x, 0]],
        ]
    )
    unit = 2 * (parts * by_R).sum((1, 2))
    return (unit - q / length * (unit @ q / length)) / length
