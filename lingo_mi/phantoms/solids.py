"""Signed-distance solids, evaluated only near their surface, and textures fixed in space.

A solid is a frozen dataclass with `bounds` (lower and upper corner, [2, 3]) and a call `solid(x, y, z)` that
returns the signed distance (negative inside, same unit as the coordinates) on broadcastable float32
coordinates. Distances of cones and ellipsoids are approximate away from their surface (the forms of I.
Quilez, "Distance functions", iquilezles.org). At the surface, where they give partial volumes, they are exact
to first order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage, sparse
from scipy.interpolate import PchipInterpolator

SPREAD = 0.55  # tangent of the mean angle by which a branch turns away from the one that it leaves
Point: TypeAlias = tuple[float, ...] | np.ndarray  # x, y, z


def _f(p):
    return np.asarray(p, np.float32)


@dataclass(frozen=True)
class Cone:
    """A capsule from a to b with a radius that varies linearly from ra to rb."""

    a: Point
    b: Point
    ra: float
    rb: float

    @property
    def bounds(self) -> np.ndarray:
        low = [min(a - self.ra, b - self.rb) for a, b in zip(self.a, self.b)]
        return np.array([low, [max(a + self.ra, b + self.rb) for a, b in zip(self.a, self.b)]])

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        a, ab = _f(self.a), _f(self.b) - _f(self.a)
        x, y, z = x - a[0], y - a[1], z - a[2]
        t = np.clip((x * ab[0] + y * ab[1] + z * ab[2]) / max(ab @ ab, 1e-12), 0, 1)
        d = (x - t * ab[0]) ** 2
        d += (y - t * ab[1]) ** 2
        d += (z - t * ab[2]) ** 2
        np.sqrt(d, out=d)
        return d - (np.float32(self.ra) + t * np.float32(self.rb - self.ra))


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid; the rows of `axes` are its unit axes."""

    centre: Point
    radii: tuple
    axes: np.ndarray | None = None

    @property
    def bounds(self) -> np.ndarray:
        axes = np.eye(3) if self.axes is None else self.axes
        half = np.sqrt(((axes * np.array(self.radii)[:, None]) ** 2).sum(0))
        return np.stack([self.centre - half, self.centre + half])

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        q0 = q1 = np.float32(0)
        for p, r in zip(local(x, y, z, self.centre, self.axes), self.radii):
            p = p / np.float32(r)
            q0 = q0 + p * p
            p = p / np.float32(r)
            q1 = q1 + p * p
        k = np.sqrt(q0)
        return k * (k - 1) / np.maximum(np.sqrt(q1), np.float32(1e-6))


@dataclass(frozen=True)
class RoundedBox:
    """A box with half sides `half` (rounding included) and edges rounded by the radius `edge`."""

    centre: Point
    half: tuple
    edge: float
    axes: np.ndarray | None = None

    @property
    def bounds(self) -> np.ndarray:
        axes = np.eye(3) if self.axes is None else self.axes
        half = np.abs(axes * np.array(self.half)[:, None]).sum(0)
        return np.stack([self.centre - half, self.centre + half])

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        q = [np.abs(p) - np.float32(h - self.edge) for p, h in zip(local(x, y, z, self.centre, self.axes), self.half)]
        outside = np.sqrt(sum(np.maximum(p, 0) ** 2 for p in q))
        return outside + np.minimum(np.maximum(np.maximum(q[0], q[1]), q[2]), 0) - np.float32(self.edge)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along the world axis `axis`, half its length `half`, rims rounded by the radius `edge`."""

    centre: Point
    radius: float
    half: float
    edge: float
    axis: int = 0

    @property
    def bounds(self) -> np.ndarray:
        half = np.full(3, self.radius)
        half[self.axis] = self.half
        return np.stack([self.centre - half, self.centre + half])

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        p = local(x, y, z, self.centre, None)
        along = np.abs(p.pop(self.axis)) - np.float32(self.half - self.edge)
        across = np.sqrt(p[0] ** 2 + p[1] ** 2) - np.float32(self.radius - self.edge)
        outside = np.sqrt(np.maximum(along, 0) ** 2 + np.maximum(across, 0) ** 2)
        return outside + np.minimum(np.maximum(along, across), 0) - np.float32(self.edge)


@dataclass(frozen=True)
class Blend:
    """The smooth union of solids, rounded over the distance k (0: the plain union)."""

    parts: tuple
    k: float = 0.0

    @property
    def bounds(self) -> np.ndarray:
        b = np.stack([p.bounds for p in self.parts])
        return np.stack([b[:, 0].min(0), b[:, 1].max(0)])

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        d = self.parts[0](x, y, z)
        for part in self.parts[1:]:
            d = smooth_min(d, part(x, y, z), self.k)
        return d


@dataclass(frozen=True)
class Cut:
    """A solid cut by the plane through `point`. `normal` (unit) points into the part that is kept."""

    solid: Any
    point: Point
    normal: tuple
    k: float = 0.0

    @property
    def bounds(self) -> np.ndarray:
        return self.solid.bounds

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        behind = -sum(q * np.float32(n) for q, n in zip(local(x, y, z, self.point, None), self.normal))
        return smooth_max(self.solid(x, y, z), behind, self.k)


def tube(points: Sequence | np.ndarray, radii: Sequence[float] | np.ndarray, k: float = 0.0, smooth: int = 0) -> Blend:
    """A chain of cones through `points` with the given radii.

    Parameters
    ----------
    smooth : int
        Cones per stretch of a monotone cubic through the points; 0: straight stretches.
    """
    places, thick = np.asarray(points, float), np.asarray(radii, float)
    if smooth:
        knots = np.arange(len(places))
        fine = np.linspace(0, knots[-1], smooth * knots[-1] + 1)
        places, thick = (PchipInterpolator(knots, v)(fine) for v in (places, thick))
    return Blend(
        tuple(Cone(tuple(a), tuple(b), ra, rb) for a, b, ra, rb in zip(places[:-1], places[1:], thick[:-1], thick[1:])),
        k,
    )


def smooth_min(a: Any, b: Any, k: float) -> Any:
    """Polynomial smooth minimum: rounds the crease where |a - b| < k."""
    if k == 0:
        return np.minimum(a, b)
    width = np.float32(k)
    h = np.maximum(width - np.abs(a - b), 0)
    return np.minimum(a, b) - h * h / (4 * width)


def smooth_max(a: Any, b: Any, k: float) -> Any:
    """Polynomial smooth maximum: rounds the edge where |a - b| < k."""
    return -smooth_min(-a, -b, k)


def local(x: np.ndarray, y: np.ndarray, z: np.ndarray, centre: Point, axes: np.ndarray | None) -> list[np.ndarray]:
    """Coordinates relative to `centre` along the rows of `axes`."""
    c = _f(centre)
    p = [x - c[0], y - c[1], z - c[2]]
    return p if axes is None else [r[0] * p[0] + r[1] * p[1] + r[2] * p[2] for r in _f(axes)]


def yaw_pitch_roll(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Axes [3, 3] (rows) turned by yaw about z, then pitch about x, then roll about y, in degrees."""
    angles = np.radians([yaw, pitch, roll])
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return (about_z @ about_x @ about_y).T


class Cube:
    """Voxel centres of a cube of `size`^3 voxels whose side `side` starts at `origin` (anatomical
    coordinates)."""

    def __init__(self, size: int, side: float, origin: Sequence[float] | np.ndarray):
        self.size, self.h = size, side / size
        self.shape = (size, size, size)
        self.axes = [
            np.float32(o) + (np.arange(size, dtype=np.float32) + np.float32(0.5)) * np.float32(self.h) for o in origin
        ]
        self.origin = np.array(origin, float)

    def near(
        self, solid: Any, pad: float
    ) -> tuple[tuple[slice, ...], tuple[np.ndarray, np.ndarray, np.ndarray]] | None:
        """Slices of the voxels within `pad` of a solid's bounds, and their coordinates; None without any."""
        where = []
        for lo, hi, start in zip(*solid.bounds, self.origin):
            first = max(int((lo - pad - start) // self.h), 0)
            last = min(int(-((start - hi - pad) // self.h)), self.size)
            if last <= first:
                return None
            where.append(slice(first, last))
        return tuple(where), self.at(where)

    def at(self, where: Sequence[slice]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Broadcastable coordinates of a box of voxels."""
        x, y, z = (a[s] for a, s in zip(self.axes, where))
        return x[:, None, None], y[None, :, None], z[None, None, :]

    def cover(self, distance: np.ndarray) -> np.ndarray:
        """The covered fraction of a voxel whose centre is at a signed distance from a surface."""
        return np.clip(np.float32(0.5) - distance / np.float32(self.h), 0, 1)

    def paint(self, image: np.ndarray, solid: Any, value: Any, soft: float = 0.0) -> None:
        """Blend `value` (a number or a function of the box's slices) into `image` inside a solid.

        Parameters
        ----------
        soft : float
            Width over which the solid's edge fades, at least a voxel.
        """
        near = self.near(solid, max(self.h, soft))
        if near is None:
            return
        where, p = near
        c = np.clip(np.float32(0.5) - solid(*p) / np.float32(max(self.h, soft)), 0, 1)
        image[where] += c * ((value(where) if callable(value) else np.float32(value)) - image[where])


def union(grid: Cube, solids: Iterable, k: float, pad: float) -> np.ndarray:
    """Smooth union of many solids over a whole grid, each evaluated within `pad` of its bounds; `pad`
    elsewhere."""
    d = np.full(grid.shape, pad, np.float32)
    for s in solids:
        near = grid.near(s, pad)
        if near is not None:
            where, p = near
            d[where] = smooth_min(d[where], np.minimum(s(*p), np.float32(pad)), k)
    return d


def _resampling(n, step, start, h, size, wrap):
    """Averages over voxels of piecewise constant samples with `step` spacing: a sparse matrix [size, n]."""
    edges = (start + h * np.arange(size + 1)) / step
    rows, columns, weights = [], [], []
    for i, (a, b) in enumerate(zip(edges[:-1], edges[1:])):
        cells = np.arange(int(np.floor(a)), int(np.ceil(b)))
        w = np.minimum(cells + 1, b) - np.maximum(cells, a)
        rows.append(np.full(len(cells), i))
        columns.append(cells % n if wrap else np.clip(cells, 0, n - 1))
        weights.append(w / w.sum())
    rows, columns, weights = map(np.concatenate, (rows, columns, weights))
    return sparse.csr_matrix((weights.astype(np.float32), (rows, columns)), (size, n))


def subdivide(coarse: np.ndarray, grid: Cube) -> np.ndarray:
    """A smooth field given on a coarser or finer cubic grid over the same cube, at the voxels of `grid`
    (linear)."""
    n = coarse.shape[0]
    position = np.clip((np.arange(grid.size) + 0.5) * n / grid.size - 0.5, 0, n - 1)
    first = np.minimum(position.astype(int), n - 2)
    t = (position - first).astype(np.float32)
    for axis in range(3):
        w = t.reshape([-1 if a == axis else 1 for a in range(3)])
        low = np.take(coarse, first, axis)
        coarse = low + w * (np.take(coarse, first + 1, axis) - low)
    return coarse


class Texture:
    """Periodic band-limited noise fixed in space: mean 0, deviation 1, the same at every grid size.

    period, step   period and sample spacing, in the grid's unit
    scales         correlation lengths along x, y, z: the band's fine end
    A voxel receives the average of the noise over its extent, so coarse grids are averages of fine ones.
    """

    def __init__(self, rng: np.random.Generator, period: float, step: float, scales: ArrayLike):
        n = round(period / step)
        self.step = step
        noise = rng.standard_normal((n, n, n), dtype=np.float32)
        sigma = np.array(scales) / step
        fine = ndimage.gaussian_filter(noise, sigma, mode='wrap', truncate=3)
        noise = fine - ndimage.gaussian_filter(fine, 1.8 * sigma, mode='wrap', truncate=3)
        self.noise = noise / noise.std()

    def __call__(self, grid: Cube, where: Sequence[slice] | None = None) -> np.ndarray:
        out = self.noise
        where = where or (slice(0, grid.size),) * 3
        for axis, s in enumerate(where):
            m = _resampling(
                len(self.noise), self.step, grid.origin[axis] + s.start * grid.h, grid.h, s.stop - s.start, True
            )
            moved = np.moveaxis(out, axis, 0)
            flat = m @ np.ascontiguousarray(moved).reshape(moved.shape[0], -1)
            out = np.moveaxis(flat.reshape(-1, *moved.shape[1:]), 0, axis)
        return out


@dataclass(frozen=True)
class Branching:
    """Properties that all branches of a random tree share.

    Parameters
    ----------
    inside : callable or None
        Predicate of a point [3]: a branch that would leave it ends there; None: anywhere.
    shrink : float
        Radius of a branch's end over the radius of its start.
    """

    inside: Callable[[np.ndarray], bool] | None = None
    shrink: float = 0.8


def branches(
    rng: np.random.Generator,
    start: ArrayLike,
    direction: ArrayLike,
    length: float,
    radius: float,
    depth: int,
    kind: Branching = Branching(),
) -> list[Cone]:
    """A random branching tree as cones: each branch bends a little and ends in two thinner ones.

    Parameters
    ----------
    start, direction : array_like
        Start and direction of the first branch, [3]; the direction may have any length.
    length, radius : float
        Length and radius of the first branch.
    depth : int
        Generations of branches after it.
    """
    start, direction = np.asarray(start, float), np.asarray(direction, float)
    direction = direction / np.linalg.norm(direction)
    cones = []
    thin = radius * kind.shrink
    for i in range(3):
        direction = direction + rng.normal(0, 0.13, 3)
        direction /= np.linalg.norm(direction)
        end = start + direction * length / 3
        if kind.inside is not None and not kind.inside(end):
            return cones
        r0, r1 = radius + (thin - radius) * i / 3, radius + (thin - radius) * (i + 1) / 3
        cones.append(Cone(tuple(start), tuple(end), r0, r1))
        start = end
    if depth > 0:
        side = np.cross(direction, rng.normal(size=3))
        side /= np.linalg.norm(side)
        for sign in (1, -1):
            turned = direction + sign * side * SPREAD * rng.uniform(0.6, 1.3)
            shorter = length * rng.uniform(0.7, 0.9)
            cones += branches(rng, start, turned, shorter, thin, depth - 1, kind)
    return cones
