"""Clouds in views at the limits of float32: needles, tiny and huge Gaussians, ends of rays, piles, extreme geometries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.rays import Rays
from lingo_mi.validation.oracle import Cloud, random_cloud
from studies.hard_cases.kinds import ViewCase


def in_views() -> Iterator[ViewCase]:
    """All of them."""
    for cases in (_shapes, _sizes, _densities, _places, _numbers, _geometries):
        yield from cases()


def scanner(
    mode: str = 'cone',
    shape: tuple[int, int] = (24, 32),
    angle: float = 33.0,
    size: tuple[float, float] = (3.2, 3.0),
    **changes: Any,
) -> tuple[Rays, tuple]:
    """Rays of one view of a scanner around [-1, 1]^3, and the panel's shape (v, u).

    Parameters
    ----------
    angle : float
        In degrees.
    size : tuple[float, float]
        Size of the panel, (v, u).
    changes
        Changes of the `Geometry`.
    """
    pixel = [s / n for s, n in zip(size, shape)]
    settings = dict(DSO=5.0, DSD=7.5, nDetector=shape, dDetector=pixel, grid=Grid(8, 0.25), angles=np.radians([angle]))
    return CircularGeometry(**{**settings, 'mode': mode, **changes}).rays(), shape


def turned(rng: np.random.Generator, n: int) -> np.ndarray:
    """n random orientations, and among the first the axes and diagonals of the world."""
    special = Rotation.from_euler(
        'zyx', [(0, 0, 0), (90, 0, 0), (0, 90, 0), (45, 0, 0), (0, 45, 0), (45, 45, 0)], degrees=True
    )
    return np.concatenate([special.as_quat(), Rotation.random(n, rng).as_quat()])


def through_view(
    rng: np.random.Generator,
    scale: ArrayLike,
    rays: Rays,
    shape: tuple[int, int],
    rotation: np.ndarray,
    reach: float = 1.5,
    depth: float = 0.3,
) -> Cloud:
    """Gaussians that all reach into the view but whose centres may lie far outside.

    Each has a point that projects into the panel, up to `reach` standard deviations from its centre along each axis.
    """
    n = len(rotation)
    scale = np.broadcast_to(np.array(scale, float), (n, 3))
    height, width = shape
    x, y = rng.uniform(0, width, (n, 1)), rng.uniform(0, height, (n, 1))
    on_panel = rays.corner[0] + x * rays.u[0] + y * rays.v[0]
    share = rng.uniform(0.5 * (1 - depth), 0.5 * (1 + depth), (n, 1)) * 4 / 3
    if rays.parallel:  # noqa: SIM108 - too long for one line
        point = on_panel - 2.5 * rays.source[0]
    else:
        point = rays.source[0] + share * (on_panel - rays.source[0])
    off = rng.uniform(-reach, reach, (n, 3)) * scale
    return Cloud(point + Rotation.from_quat(rotation).apply(off), scale, rotation, rng.uniform(0.2, 1, n))


def close_up(mode: str, shape: tuple[int, int] = (24, 32), pixel: float = 1.5e-4, **changes: Any) -> tuple[Rays, tuple]:
    """A panel of tiny pixels that sees the middle of the scene under a magnifying glass."""
    return scanner(mode, shape, size=(shape[0] * pixel, shape[1] * pixel), **changes)


def _shapes():
    rng = np.random.default_rng(1)
    for mode in ('cone', 'parallel'):
        views = {'close up': close_up(mode), 'whole': scanner(mode)}
        for kind, scale in dict(needles=(0.3, 3e-5, 3e-5), pancakes=(0.3, 0.3, 3e-5)).items():
            for where, view in views.items():
                yield ViewCase(
                    f'{kind} 1:1e4, {mode}, {where}', through_view(rng, scale, *view, turned(rng, 40)), *view
                )
        view = close_up(mode)
        yield ViewCase(f'needles 1:1e4 seen end on, {mode}', _end_on(rng, (0.3, 3e-5, 3e-5), *view), *view)
        yield ViewCase(f'pancakes 1:1e4 seen edge on, {mode}', _end_on(rng, (0.3, 3e-5, 0.3), *view), *view)


def _end_on(rng, scale, rays, shape, n=30):
    """Gaussians whose first axis points along the beam but for up to a few times their aspect."""
    beam = rays.corner[0] + shape[1] / 2 * rays.u[0] + shape[0] / 2 * rays.v[0] - rays.source[0]
    beam = rays.source[0] if rays.parallel else beam / np.linalg.norm(beam)
    side = np.cross(beam, [0, 0, 1])
    basis = Rotation.from_matrix(np.stack([beam, side / np.linalg.norm(side), np.cross(beam, side)], 1))
    tilt = Rotation.from_rotvec(rng.normal(size=(n, 3)) * [3, 3e-4, 3e-4])
    return through_view(rng, scale, rays, shape, (basis * tilt).as_quat(), reach=0.3, depth=0)


def _sizes():
    for mode in ('cone', 'parallel'):
        rays, shape = scanner(mode)
        pixel = np.linalg.norm(rays.u[0]) / (1 if mode == 'parallel' else 1.5)
        for power in (-6, -4, -2, -1, 0):
            rng = np.random.default_rng(10 + power)
            size = pixel * 10.0**power
            cloud = _on_pixel_centres(rng, rays, shape, size, 16)
            yield ViewCase(f'scale 1e{power} pixels, {mode}', cloud, rays, shape, analytic=power == -6)
        for size in (2.0, 20.0):
            rng = np.random.default_rng(5)
            scale = size * rng.uniform(0.7, 1.3, (3, 3))
            cloud = Cloud(rng.uniform(-1, 1, (3, 3)), scale, rng.normal(size=(3, 4)), [0.2, 0.4, 0.6])
            yield ViewCase(f'scale of {size / 2:g} scenes, {mode}', cloud, rays, shape)


def _on_pixel_centres(rng, rays, shape, size, n):
    """Gaussians of about one size within a standard deviation or two of the ray of a pixel's centre."""
    x, y = rng.integers(2, shape[1] - 2, (n, 1)) + 0.5, rng.integers(2, shape[0] - 2, (n, 1)) + 0.5
    on_panel = rays.corner[0] + x * rays.u[0] + y * rays.v[0]
    if rays.parallel:
        beam = rays.source[0]
        points = on_panel - 2.5 * beam
    else:
        beam = on_panel - rays.source[0]
        points = rays.source[0] + beam / 1.5
    points = np.float32(points + size * rng.normal(size=(n, 3))).astype(float)
    if size < 1e-3:
        # The nearest float32 numbers may miss the ray by many standard deviations: of the places along it, take those
        # that miss it by about one.
        start = on_panel if rays.parallel else rays.source[0]
        along = np.broadcast_to(beam, on_panel.shape) / np.linalg.norm(beam, axis=-1, keepdims=True)
        t = np.linspace(-0.3, 0.3, 4001)[:, None, None]
        trial = np.float32(points + t * along).astype(float)  # [4001, n, 3]
        r = trial - start
        miss = np.linalg.norm(r - (r * along).sum(-1, keepdims=True) * along, axis=-1)
        points = trial[np.abs(miss - size).argmin(0), np.arange(n)]
    return Cloud(points, size * rng.uniform(0.7, 1.4, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.2, 1, n))


def _densities():
    for mode in ('cone', 'parallel'):
        rays, shape = scanner(mode)
        for value in (0.0, 1e-12, 1e6):
            cloud = random_cloud(np.random.default_rng(3), 12)
            yield ViewCase(f'density {value:g}, {mode}', cloud.changed(density=np.full(12, value)), rays, shape)
        cloud = random_cloud(np.random.default_rng(4), 12)
        for length in (1e-12, 1e12):
            q = cloud.rotation / np.linalg.norm(cloud.rotation, axis=1, keepdims=True)
            yield ViewCase(f'quaternions of length {length:g}, {mode}', cloud.changed(rotation=length * q), rays, shape)


def _places():
    ahead = -np.array([np.cos(np.radians(33)), np.sin(np.radians(33)), 0])  # from the source to the panel's middle
    side = np.array([-ahead[1], ahead[0], 0])
    gaussian = dict(scale=[[0.2, 0.16, 0.26]], rotation=[[0.1, 0.4, -0.3, 0.8]], density=[0.7])
    rays, shape = scanner()
    source = np.float32(rays.source[0])
    places = {
        'centre outside the fan, reaching in': (1.9 * side, 1),
        'centre outside the fan': (4 * side, 1),
        'centre 1000 scenes above the fan': ([0, 0, 2e3], 1),
        'behind the source': (6.5 * -ahead, 1),
        'behind the source, reaching ahead': (5.4 * -ahead, 1),
        'beside the source': (source + 0.9 * side, 1),
        'just ahead of the source': (4.6 * -ahead, 0.6),
        'centre at the source': (source, 1),
        'source inside a Gaussian': (5 * -ahead + 0.05, 1),
        'source inside a tiny Gaussian': (source + 3e-5, 3e-4),
        'centre on the panel': (2.5 * ahead + 0.3 * side, 1),
        'centre on the panel, below a pixel': (2.5 * ahead, 0.1),
        'behind the panel': (3.9 * ahead, 1),
        'behind the panel, reaching through': (2.9 * ahead, 0.8),
        'from source to panel': (0 * ahead, 6),
    }
    for name, (centre, size) in places.items():
        cloud = Cloud([centre], size * np.array(gaussian['scale']), gaussian['rotation'], gaussian['density'])
        case = ViewCase(name, cloud, rays, shape)
        if name == 'centre outside the fan, reaching in':
            case = replace(case, image=2e-6, note='a far tail only')
        yield case
    rays, shape = scanner('parallel')
    for name in ('centre outside the fan, reaching in', 'behind the source', 'centre on the panel', 'behind the panel'):
        centre, size = places[name]
        cloud = Cloud([centre], size * np.array(gaussian['scale']), gaussian['rotation'], gaussian['density'])
        yield ViewCase(f'{name}, parallel: never cut'.replace('the fan', 'the beam'), cloud, rays, shape)
    rays, shape = scanner(shape=(25, 33))
    turn = Rotation.from_euler('z', 33 + 1e-4, degrees=True).as_quat()[None]
    for kind, scale in dict(needle=(0.3, 3e-5, 3e-5), pancake=(0.3, 0.3, 3e-5)).items():
        yield ViewCase(f'{kind} 1:1e4 through the source', Cloud([source + 2e-6], [scale], turn, [1.0]), rays, shape)


def _numbers():
    note = 'added one by one in float32, up to a thousand at a time'
    for mode in ('cone', 'parallel'):
        rays, shape = scanner(mode)
        cloud = random_cloud(np.random.default_rng(6), 1)
        yield ViewCase(f'one Gaussian, {mode}', cloud, rays, shape)
        yield ViewCase(f'30 coincident Gaussians, {mode}', cloud, rays, shape, copies=30)
        yield ViewCase(f'3000 coincident Gaussians, {mode}', cloud, rays, shape, image=3e-6, copies=3000, note=note)
        sharp, _ = scanner(mode, size=(0.4, 0.5))
        small = Cloud([[0, 0, 0]], [[0.004, 0.005, 0.006]], [[0.1, 0.4, -0.3, 0.8]], [1.0])
        yield ViewCase(f'pixels 30 standard deviations out, {mode}', small, sharp, shape)
    rays, shape = scanner(shape=(4, 4), size=(0.4, 0.4))
    cloud = random_cloud(np.random.default_rng(6), 1, spread=0.1, size=0.1)
    yield ViewCase('1 million coincident Gaussians', cloud, rays, shape, image=3e-6, copies=1_000_000, note=note)
    cloud = random_cloud(np.random.default_rng(6), 1_000_000, size=0.005)
    yield ViewCase('1 million Gaussians', cloud, *scanner(shape=(3, 3)), image=2e-6, note=note)


def _geometries():
    cloud = random_cloud(np.random.default_rng(7), 12)
    for mode in ('cone', 'parallel'):
        for shape, size in (((1, 1), (0.05, 0.05)), ((1, 4096), (0.01, 3.0)), ((4096, 1), (3.0, 0.01))):
            rays, _ = scanner(mode, shape, size=size)
            near = cloud.changed(centre=cloud.centre * ([0.05, 0.05, 0.05] if shape == (1, 1) else [1, 1, 0.03]))
            yield ViewCase(f'{shape[0]} x {shape[1]} pixels, {mode}', near, rays, shape)
        for shift in (1e4, 1e6):
            rays, shape = scanner(mode)
            shift = np.array([2.0, -1.4, 0.9]) * shift
            # Float32 names places this far out only to a thousandth of the scene, so the rounded places count.
            size = cloud.changed(centre=cloud.centre + shift)
            moved = Rays(
                rays.source + (0 if rays.parallel else shift), rays.corner + shift, rays.u, rays.v, rays.parallel
            )
            yield ViewCase(f'world offset of {np.abs(shift).max() / 2:.0e} scenes, {mode}', size, moved, shape)
        for angle in (33.0, 33.0 + np.degrees(1e-6)):
            rays, shape = scanner(mode, angle=angle)
            yield ViewCase(f'view at {np.radians(angle):.7f} rad, {mode}', cloud, rays, shape)
    far = scanner(DSO=5e4, DSD=7.5e4)
    yield ViewCase('cone beam from 25000 scenes away', cloud, *far)
    wide = scanner(DSO=1.9, DSD=2.9, size=(12, 14))
    yield ViewCase('cone of 157 degrees', cloud, *wide)
    yield ViewCase('pixels 1000 times as wide as high', cloud, *scanner(shape=(1000, 3), size=(1.0, 3.0)))
