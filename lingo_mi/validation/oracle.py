"""Line integrals, densities and derivatives of a cloud of Gaussians in float64 NumPy, written to be obviously right.

    sigma(x) = sum_i rho_i exp(-1/2 |diag(1/s_i) R_i^T (x - p_i)|^2)

Along a ray o + t D every term is a Gaussian in t. With w = W(p - o), d = W D and m = w.d / |d|^2 it is
rho exp(-1/2 |w - m d|^2) exp(-1/2 |d|^2 (t - m)^2), which integrates to the error function.

Derivatives are finite differences with a five-point stencil. The module `closed_form` differentiates by hand instead. Both
are needed. Only this module has rays that begin at a source, densities at points, and derivatives by the pose. Only
`closed_form` has Gaussians too small for finite differences, whole images of thousands of Gaussians, and means over pixels. Each
is tested against the other.

    rng = np.random.default_rng(0)
    rays = geometry.rays()                       # of a lingo_mi.geometry.base.Geometry
    pose = Pose.of(rays, 0, *geometry.nDetector)
    image = line_integrals(random_cloud(rng, 5), pose)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import erf

from lingo_mi.geometry.rays import Rays


@dataclass(frozen=True, init=False)
class Cloud:
    """Gaussians: centre, scale [N, 3]; rotation [N, 4], quaternions (x, y, z, w) of any length; density [N], at the centre.

    Columns are rounded to what float32 holds of them, so that rounding the input counts as no error of who is measured.
    """

    centre: np.ndarray
    scale: np.ndarray
    rotation: np.ndarray
    density: np.ndarray

    def __init__(self, centre: ArrayLike, scale: ArrayLike, rotation: ArrayLike, density: ArrayLike):
        columns = dict(centre=centre, scale=scale, rotation=rotation, density=density)
        for name, column in columns.items():
            object.__setattr__(self, name, np.array(column, np.float32).astype(float))

    def __len__(self):
        return len(self.density)

    def __getitem__(self, index):
        return Cloud(*(getattr(self, f.name)[index] for f in fields(self)))

    def __add__(self, other):
        return Cloud(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))

    def changed(self, **columns: ArrayLike) -> Cloud:
        """The cloud with other columns, such as density=np.ones(len(cloud))."""
        return replace(self, **columns)


def random_cloud(
    rng: np.random.Generator, n: int, spread: float = 0.6, size: float = 0.08, centre: ArrayLike = (0.0, 0.0, 0.0)
) -> Cloud:
    """n Gaussians with centres in a cube of half side `spread`, scales around `size`, any rotation and length of it."""
    return Cloud(
        np.array(centre) + rng.uniform(-spread, spread, (n, 3)),
        size * np.exp(rng.normal(0, 0.4, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.uniform(0.2, 1, n),
    )


@dataclass(frozen=True)
class Pose:
    """One view as in `lingo_mi.geometry.rays.Rays`: `source` is a point, or the unit direction of a parallel beam."""

    source: np.ndarray
    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    height: int
    width: int
    parallel: bool = False

    @staticmethod
    def of(rays: Rays, index: int, height: int, width: int) -> Pose:
        """View `index` of a `lingo_mi.geometry.rays.Rays`, for an image of height x width pixels."""
        source, corner, u, v = (np.array(a[index], float) for a in (rays.source, rays.corner, rays.u, rays.v))
        return Pose(source, corner, u, v, height, width, rays.parallel)

    @staticmethod
    def of_view(view: Any) -> Pose:
        """A `lingo_mi.projectors.view.View`."""
        source, corner, u, v = (np.array(x, float).ravel() for x in (view.source, view.corner, view.u, view.v))
        return Pose(source, corner, u, v, view.height, view.width, view.parallel)

    @property
    def begin(self) -> float:
        """The t at which integrals begin: 0 at a cone beam's source, else minus infinity."""
        return -np.inf if self.parallel else 0.0

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Starts and directions [height * width, 3] through the pixel centres, row by row; t = 1 is on the panel."""
        y, x = np.divmod(np.arange(self.height * self.width), self.width)
        on_panel = self.corner + (x + 0.5)[:, None] * self.u + (y + 0.5)[:, None] * self.v
        if self.parallel:
            return on_panel, np.broadcast_to(self.source, on_panel.shape)
        return np.broadcast_to(self.source, on_panel.shape), on_panel - self.source


def whiten(scale: ArrayLike, rotation: ArrayLike, vectors: np.ndarray) -> np.ndarray:
    """diag(1/s) R^T v for one Gaussian."""
    return vectors @ Rotation.from_quat(rotation).as_matrix() / scale


def gaussian_integral(gaussian: tuple, start: np.ndarray, direction: np.ndarray, begin: float = -np.inf) -> np.ndarray:
    """Line integrals of one Gaussian along rays, for t from `begin` on, [M].

    Parameters
    ----------
    gaussian : tuple
        Its centre, scale, rotation and density, as `rows` gives them.
    start, direction : ndarray [M, 3]
    """
    centre, scale, rotation, density = gaussian
    w, d = whiten(scale, rotation, centre - start), whiten(scale, rotation, direction)
    dd = (d * d).sum(1)
    m = (w * d).sum(1) / dd
    nearest = w - m[:, None] * d
    step = np.sqrt(dd / 2)
    share = 0.5 * (1 - erf((begin - m) * step))
    length = np.linalg.norm(direction, axis=1)
    return density * np.sqrt(2 * np.pi / dd) * length * np.exp(-0.5 * (nearest**2).sum(1)) * share


def line_integrals(cloud: Cloud, pose: Pose) -> np.ndarray:
    """The image of a cloud, [height * width], row by row."""
    rays = pose.rays()
    return sum((gaussian_integral(row, *rays, pose.begin) for row in rows(cloud)), np.zeros(pose.height * pose.width))


def rows(cloud: Cloud) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
    """The Gaussians one by one: centre, scale, rotation, density."""
    return zip(cloud.centre, cloud.scale, cloud.rotation, cloud.density)


def derivative(function: Callable[..., Any], step: Any) -> Any:
    """f'(0) by the five-point stencil, exact to the fourth power of the step."""
    a, b, c, d = (function(k * step) for k in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * step)


def gradients(cloud: Cloud, pose: Pose, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Derivatives of sum(weights * image) by all parameters: a dict of arrays shaped like the cloud's."""
    rays = pose.rays()
    return _gradients(cloud, lambda row: (weights * gaussian_integral(row, *rays, pose.begin)).sum())


def values_at(cloud: Cloud, points: np.ndarray) -> np.ndarray:
    """sigma [M] at points [M, 3]."""
    return sum((_value(row, points) for row in rows(cloud)), np.zeros(len(points)))


def value_gradients(cloud: Cloud, points: np.ndarray, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Derivatives of sum(weights * sigma(points)), like `gradients`."""
    return _gradients(cloud, lambda row: (weights * _value(row, points)).sum())


def _value(gaussian, points):
    centre, scale, rotation, density = gaussian
    return density * np.exp(-0.5 * (whiten(scale, rotation, points - centre) ** 2).sum(-1))


def _gradients(cloud, loss, step=1e-3):
    names = 'centre', 'scale', 'rotation', 'density'
    out = {name: np.zeros_like(getattr(cloud, name)) for name in names}
    for i, row in enumerate(rows(cloud)):
        # A step is small against the Gaussian, whatever its size.
        lengths = dict(
            centre=row[1].min(),
            scale=row[1],
            rotation=np.linalg.norm(row[2]) * row[1].min() / row[1].max(),
            density=row[3],
        )
        for k, name in enumerate(names):
            for index in np.ndindex(np.shape(row[k])):
                h = step * np.broadcast_to(lengths[name], np.shape(row[k]))[index]

                def moved(by, k=k, index=index):
                    changed = [np.array(x) for x in row]
                    changed[k][index] += by
                    return loss(changed)

                out[name][(i, *index)] = derivative(moved, h) if h else loss((*row[:3], 1.0))
    return out


def pose_gradients(cloud: Cloud, pose: Pose, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Derivatives of sum(weights * image) by the view's four vectors."""
    smallest = cloud.scale.min()
    reach = dict(source=1, corner=1, u=pose.width, v=pose.height)
    if pose.parallel:
        reach['source'] = np.linalg.norm(cloud.centre - pose.corner, axis=1).max()
    out = {}
    for name, times in reach.items():
        out[name] = np.array(
            [
                derivative(
                    lambda by: (
                        weights * line_integrals(cloud, replace(pose, **{name: getattr(pose, name) + by * axis}))
                    ).sum(),
                    1e-3 * smallest / times,
                )
                for axis in np.eye(3)
            ]
        )
    return out


def relative(result: ArrayLike, expected: ArrayLike) -> float:
    """Root mean square deviation over the root mean square of the expected values."""
    result, expected = np.ravel(result), np.ravel(expected)
    return float(np.linalg.norm(result - expected) / np.linalg.norm(expected))
