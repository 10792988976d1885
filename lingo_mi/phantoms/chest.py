"""A chest in a 380 mm cube: much air inside, thin ribs, fine vessels.

+x is the patient's right, +y the front, +z the head; the trunk and the raised arms leave through the cube's
faces. Densities follow the rule of R2-Gaussian's data, Hounsfield units clipped to [-1000, 2000] and scaled
to [0, 1] (`density`): air 0, lung 0.07 to 0.1, fat 0.3, soft tissue 0.345 to 0.365, bone 0.42 to 0.7; outside
is exactly 0. A voxel holds its average to first order; textures are fixed in space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from lingo_mi.phantoms.solids import (
    Blend,
    Branching,
    Cone,
    Cube,
    Cylinder,
    Ellipsoid,
    RoundedBox,
    Texture,
    branches,
    smooth_max,
    smooth_min,
    subdivide,
    tube,
    union,
    yaw_pitch_roll,
)

SIDE = 380.0  # mm
_COARSE = 96  # lattice of the smooth fields, for all sizes
_SIDES = (1, -1)


def density(hu: Any) -> Any:
    """Hounsfield units to [0, 1]: (clip(hu, -1000, 2000) + 1000) / 3000."""
    return (np.clip(hu, -1000, 2000) + 1000) / 3000


LUNG, FAT, WATER, BLOOD, MUSCLE, LIVER, CARTILAGE = (float(density(hu)) for hu in (-790, -100, 15, 48, 62, 95, 130))


@dataclass(frozen=True)
class Torso:
    """A body with an elliptic cross-section at every height: rows of (z, half width, half depth, y)."""

    rows: tuple

    def at(self, z: np.ndarray) -> list[np.ndarray]:
        """Half width, half depth and centre's y at heights z, constant beyond the rows."""
        rows = np.array(self.rows, float)
        z = np.clip(z, rows[0, 0], rows[-1, 0])
        return [PchipInterpolator(rows[:, 0], rows[:, i])(z).astype(np.float32) for i in (1, 2, 3)]

    def __call__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        a, b, c = self.at(z)
        y = y - c
        u, v = (np.abs(x) / a) ** 2.4, (np.abs(y) / b) ** 2.4
        k = (u + v) ** np.float32(1 / 2.4)
        return (k - 1) * np.sqrt(x * x + y * y) / np.maximum(k, np.float32(1e-3))


_CAGE = Torso(
    (
        (-190, 128, 88, 4),
        (-90, 136, 95, 6),
        (-20, 131, 91, 4),
        (40, 116, 79, 0),
        (80, 94, 63, -8),
        (110, 66, 46, -16),
        (132, 38, 30, -22),
    )
)
_TRUNK = Torso(
    (
        (-190, 160, 112, 0),
        (-90, 164, 117, 2),
        (0, 166, 116, 1),
        (70, 160, 103, -5),
        (110, 138, 84, -10),
        (140, 92, 66, -12),
        (165, 62, 60, -10),
        (190, 58, 60, -8),
    )
)


def _spine_y(z):
    """The front-to-back position of the vertebral bodies: the thoracic kyphosis."""
    return -66 + 14 * (z / 190) ** 2


def _spine():
    """Per vertebra its bone, and all discs."""
    bones, discs = [], []
    for i in range(17):
        z = 182 - 23.2 * i + 0.12 * i * i
        y, grow = _spine_y(z), 0.82 + 0.02 * i
        body = Cylinder((0, y, z), 17.5 * grow, 9.5, 3, axis=2)
        parts = [body, Cone((0, y - 33 * grow, z - 2), (0, y - 50, z - 24), 5, 4)]
        for s in _SIDES:
            parts += [
                Cone((s * 10, y - 13, z + 3), (s * 13, y - 22, z + 3), 4.5, 4.5),  # pedicle
                Cone((s * 13, y - 22, z + 2), (0, y - 33 * grow, z - 2), 4.5, 4.5),  # lamina
                # transverse process
                Cone((s * 13, y - 22, z + 2), (s * 32, y - 30, z + 5), 5, 5),
            ]
        bones.append(Blend(tuple(parts), 3.0))
        discs.append(Cylinder((0, _spine_y(z - 11.6), z - 11.6), 16 * grow, 2.6, 1, axis=2))
    return bones, discs


def _ribs():
    """Twelve pairs of ribs and their cartilages."""
    bones, cartilage = [], []
    for s in _SIDES:
        for i in range(12):
            z0 = 134 - 22.5 * i
            end = (128, 138, 142, 144, 143, 140, 136, 128, 118, 108, 85, 62)[i]
            drop = (34, 56, 66, 72, 76, 80, 82, 82, 80, 74, 52, 40)[i]
            phi = np.radians(np.linspace(14, end, 15))
            t = (phi - phi[0]) / np.pi
            z = z0 + 4 - drop * t**0.85 * 1.15
            a, b, c = _CAGE.at(z)
            points = np.stack([s * (a + 3) * np.sin(phi), c - (b + 3) * np.cos(phi), z], 1)
            points = np.vstack([[s * 17, _spine_y(z0) - 12, z0 + 6], points])
            r = np.full(len(points), 5.2 if i else 5.8)
            r[0], r[-1] = 5.5, 6
            bones.append(Blend(tube(points, r, smooth=1).parts, 0))
            if i < 10:
                sternum = max(82 - 13.5 * i, -12)
                stop = np.array([s * (20 if i < 7 else 26), _front(sternum) - 1, sternum - 3 * max(i - 6, 0)])
                path = [points[-1]]
                for t in (0.25, 0.5, 0.75):  # along the front of the cage, hanging down a little
                    sag = (2 if i < 3 else 12) * 4 * t * (1 - t)
                    x, _, z = points[-1] + t * (stop - points[-1]) - [0, 0, sag]
                    path.append((x, _surface(x, z), z))
                cartilage.append(tube([*path, stop], np.full(5, 5.2), smooth=3))
    return bones, cartilage


def _surface(x, z):
    """y of the front of the rib cage, where cartilages lie."""
    a, b, c = (float(v[0]) for v in _CAGE.at(np.array([float(z)])))
    return c + (b + 4) * max(1 - (abs(x) / (a + 4)) ** 2.4, 0.0) ** (1 / 2.4)


def _front(z):
    """y of the sternum's mid-plane."""
    return _surface(0, z) - 1


def _girdle():
    """Sternum, clavicles, scapulae and humeri."""
    out = [
        Blend((RoundedBox((0, _front(78), 82), (25, 6, 22), 5, yaw_pitch_roll(pitch=22)),), 0),
        Blend(
            (
                RoundedBox((0, _front(12), 12), (17, 5.5, 44), 5, yaw_pitch_roll(pitch=7)),
                Cone((0, _front(-32), -30), (0, _front(-52) - 3, -54), 6, 3.5),
            ),
            5.0,
        ),
    ]
    for s in _SIDES:
        out += [
            Blend(
                tube(
                    [(s * 20, _front(98) + 2, 103), (s * 62, 42, 122), (s * 100, 12, 134), (s * 134, -8, 138)],
                    [9, 6.2, 6, 7],
                    smooth=4,
                ).parts,
                2.0,
            ),
            Blend(
                (
                    Ellipsoid((s * 92, -83, 62), (31, 3.6, 60), yaw_pitch_roll(yaw=s * 32, roll=-s * 8)),
                    Cone((s * 70, -98, 92), (s * 124, -48, 122), 4.5, 6),
                    Cone((s * 108, -70, 100), (s * 122, -38, 112), 8, 13),
                ),
                5.0,
            ),
            Blend(
                (Ellipsoid((s * 146, -24, 126), (22, 22, 22)), Cone((s * 150, -24, 132), (s * 190, -26, 205), 14, 11)),
                6.0,
            ),
        ]
    return out


def _skin_parts():
    return [tube([(s * 118, -22, 96), (s * 150, -24, 132), (s * 196, -26, 205)], [44, 46, 42]) for s in _SIDES]


def _muscles():
    out = []
    for s in _SIDES:
        out += [
            Cone((s * 30, -104, -190), (s * 28, -104, 130), 22, 15),
            Ellipsoid((s * 72, 80, 62), (55, 16, 42)),
            Cone((s * 128, -40, 110), (s * 196, -26, 205), 34, 33),
            Ellipsoid((s * 90, -95, 62), (42, 14, 66)),
            Cone((s * 138, -30, -30), (s * 128, -42, 90), 11, 24),
            Ellipsoid((s * 42, -72, 140), (48, 26, 26)),
            Cone((s * 26, 8, 200), (s * 18, 50, 100), 11, 7),
        ]
    return out


def _lungs(coarse, cage):
    """Signed distances of the lungs, and of heart and mediastinum, on the coarse lattice."""
    x, y, z = coarse.at((slice(None),) * 3)
    heart = Blend(
        (
            Ellipsoid((-28, 30, -38), (52, 40, 58), yaw_pitch_roll(roll=38)),
            Ellipsoid((24, 22, -28), (30, 32, 44)),
            Cone((0, 18, 10), (4, 14, 60), 30, 24),
        ),
        14.0,
    )(x, y, z)
    middle = np.sqrt((x / (20 + 12 * np.exp(-(((z - 30) / 30) ** 2)))) ** 2 + ((y + 8) / 88) ** 8) - 1
    middle = smooth_min(middle * 20, heart, 12)
    spine = np.sqrt(x * x + (y - _spine_y(z)) ** 2) - 27
    domes = smooth_min(
        Ellipsoid((62, -2, -212), (92, 96, 134))(x, y, z), Ellipsoid((-66, -4, -218), (86, 96, 120))(x, y, z), 25
    )
    outside = smooth_min(smooth_min(middle, spine, 8), domes, 6)
    return smooth_max(smooth_max(cage + 5, z - 124, 12), -outside, 6), heart, domes


def _trees(rng, is_lung):
    """Pulmonary vessels and airways: (vessels, airways)."""
    vessels, airways = [], []
    for s in _SIDES:
        for x, y, z in (
            (1, 0.1, 0.9),
            (1, 0.8, 0.4),
            (1, -0.7, 0.5),
            (1, 0.3, -0.2),
            (0.8, -0.6, -0.8),
            (0.7, 0.5, -1),
            (0.9, -0.1, -1.1),
            (0.8, -0.8, -0.1),
            (0.5, 0.9, -0.7),
            (0.6, -0.2, 1.2),
        ):
            root = np.array([s * 36.0, -14 + 4 * y, 26 + 8 * z])
            for turn in rng.normal(0, 0.25, (2, 3)):  # an artery and a vein
                vessels += branches(rng, root, turn + (s * x, y, z), 38, 4.6, 7, Branching(is_lung, 0.77))
            airways += branches(rng, root + [0, -5, 3], (s * x, y, z + 0.15), 30, 3.4, 3, Branching(is_lung, 0.75))
    return vessels, airways


def build(size: int, seed: int) -> tuple[np.ndarray, float, None]:
    """Data float32 [size]^3 in [0, 1], side in mm, and no analytic form (see `phantoms.make`)."""
    rng = np.random.default_rng(seed)
    grid, coarse = (Cube(n, SIDE, np.full(3, -SIDE / 2)) for n in (size, _COARSE))
    step = SIDE / _COARSE
    texture = Texture(rng, 60.0, 1.5, (1.3, 1.3, 1.6))
    flesh = Texture(rng, 190.0, 2.5, (4.0, 4.0, 5.0))
    mottle = flesh(coarse)
    x, y, z = coarse.at((slice(None),) * 3)
    skin = smooth_min(_TRUNK(x, y, z), union(coarse, _skin_parts(), 10.0, 60.0), 25)
    cage = _CAGE(x, y, z)
    lung, heart, domes = _lungs(coarse, cage)

    tissue = np.float32(FAT) + np.float32(0.004) * mottle
    for m in _muscles():
        coarse.paint(tissue, m, lambda w: MUSCLE + np.float32(0.004) * mottle[w], 4.0)

    def fill(distance, value, soft=4.0):
        c = np.clip(np.float32(0.5) - distance / np.float32(soft), 0, 1)
        np.copyto(tissue, tissue + c * (np.float32(value) + np.float32(0.003) * mottle - tissue))

    # between and over the ribs
    fill(np.maximum(cage - 10, 1 - cage - 12), MUSCLE)
    fill(smooth_max(cage + 3, domes + 6, 8), FAT)
    fill(np.maximum(domes + 4, smooth_max(cage + 6, Ellipsoid((50, 2, -170), (92, 84, 96))(x, y, z), 8)), LIVER)
    fill(np.maximum(domes + 5, Ellipsoid((-82, -48, -140), (34, 30, 46))(x, y, z)), MUSCLE)  # spleen
    fill(np.maximum(domes + 5, Ellipsoid((-55, 24, -140), (42, 36, 40))(x, y, z)), WATER)  # stomach
    fill(heart + 5, MUSCLE, 5.0)
    for c, r in (
        ((-34, 22, -48), (24, 19, 34)),
        ((-4, 44, -34), (22, 14, 34)),
        ((24, 20, -24), (20, 21, 30)),
        ((-16, -4, -8), (30, 15, 20)),
    ):
        fill(Ellipsoid(c, r, yaw_pitch_roll(roll=30))(x, y, z), BLOOD, 4.0)  # the four chambers
    fat = np.float32(FAT) + np.float32(0.004) * mottle
    tissue += np.clip((skin + np.float32(8)) / 3, 0, 1) * (fat - tissue)  # under the skin

    image, skin, fine_lung = subdivide(tissue, grid), subdivide(skin, grid), subdivide(lung, grid)
    air = np.float32(LUNG) + np.float32(0.006) * subdivide(mottle, grid) + np.float32(0.006) * texture(grid)
    image += grid.cover(fine_lung) * (air - image)

    def is_lung(p):
        at_hilum = (abs(p[0]) - 36) ** 2 + (p[1] + 14) ** 2 + (p[2] - 26) ** 2 < 22**2
        return at_hilum or lung[tuple(np.clip((p + SIDE / 2) / step, 0, _COARSE - 1).astype(int))] < -3

    _thorax(grid, image, rng, is_lung)
    _skeleton(grid, image, texture)
    image += grid.cover(-skin - np.float32(1.8)) * (np.float32(WATER) - image)
    image *= grid.cover(skin)
    return np.clip(image, 0, 1, out=image), SIDE, None


def _thorax(grid, image, rng, is_lung):
    """Great vessels, vessels and airways of the lungs, gullet, gas in the stomach."""
    vessels, airways = _trees(rng, is_lung)
    for v in vessels:
        _thin(grid, image, v, BLOOD)
    for a in airways:
        _thin(grid, image, Cone(a.a, a.b, a.ra + 0.9, a.rb + 0.8), WATER)
    for a in airways:
        _thin(grid, image, a, 0.01)
    great = (
        (
            [(-4, 22, 0), (6, 26, 40), (4, 12, 74), (-12, -16, 86), (-24, -40, 62), (-24, -46, 0), (-18, -44, -195)],
            [14, 15, 14, 13, 12.5, 11.5, 10],
        ),
        ([(26, 16, 0), (24, 10, 60), (20, 8, 110)], [10, 9.5, 8]),
        ([(-14, 34, -4), (-20, 14, 36), (-34, -8, 32)], [13, 12.5, 9]),
        ([(-16, 4, 34), (10, 2, 30), (36, -12, 26)], [11, 10, 9]),
    )
    for points, radii in great:
        pipe = tube(points, radii, smooth=5)
        grid.paint(image, pipe, MUSCLE)
        grid.paint(image, tube(points, np.array(radii) - 1.5, smooth=5), BLOOD)
    windpipe = [
        ([(0, 4, 200), (0, -6, 120), (0, -16, 58)], [9, 9, 8.5]),
        ([(0, -16, 58), (20, -17, 40), (38, -18, 28)], [7.5, 6.5, 5]),
        ([(0, -16, 58), (-20, -18, 38), (-38, -18, 26)], [7, 6, 5]),
    ]
    for wall, value in ((2.0, CARTILAGE), (0.0, 0.0)):
        for points, radii in windpipe:
            grid.paint(image, tube(points, np.array(radii) + wall, smooth=4), value)
    grid.paint(image, tube([(-4, -26, 190), (-5, -34, 0), (-20, -10, -100)], [6, 6, 7], smooth=4), MUSCLE)
    grid.paint(image, Ellipsoid((-58, 36, -116), (26, 20, 12)), 0.0)


def _thin(grid, image, cone, value):
    """A tube that may be thinner than a voxel: it keeps its cross-section, not its full contrast."""
    r = (cone.ra + cone.rb) / 2
    wide = max(r, grid.h / 2)
    near = grid.near(Cone(cone.a, cone.b, wide, wide), grid.h)
    if near is None:
        return
    where, p = near
    seen = Cone(cone.a, cone.b, *np.maximum((cone.ra, cone.rb), grid.h / 2))
    c = grid.cover(seen(*p)) * np.float32((r / wide) ** 2)
    image[where] += c * (np.float32(value) - image[where])


def _skeleton(grid, image, texture):
    """Ribs, spine and shoulder girdle: a cortical shell around spongy bone."""
    vertebrae, discs = _spine()
    ribs, cartilage = _ribs()
    for c in cartilage:
        grid.paint(image, c, CARTILAGE)
    for d in discs:
        grid.paint(image, d, CARTILAGE)
    for solid, cortex, spongy in (
        [(v, 1.1, 0.445) for v in vertebrae] + [(r, 1.3, 0.44) for r in ribs] + [(g, 1.7, 0.44) for g in _girdle()]
    ):
        near = grid.near(solid, grid.h)
        if near is None:
            continue
        where, p = near
        d = solid(*p)
        core = spongy + np.float32(0.022) * texture(grid, where)
        inner = np.clip(np.float32(0.5) - (d + np.float32(cortex)) / max(np.float32(1.2), grid.h), 0, 1)
        image[where] += grid.cover(d) * (np.float32(0.70) + inner * (core - np.float32(0.70)) - image[where])
    # The spinal canal stays open through arches and discs.
    z = np.arange(-196.0, 197, 14)
    grid.paint(image, tube(np.stack([0 * z, _spine_y(z) - 23.5, z], 1), np.full(len(z), 7.5)), WATER)
