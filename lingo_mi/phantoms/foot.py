"""A right foot and ankle in a 256 mm cube: the project's default object.

Toes point to +y, the leg leaves through +z, lateral is +x. The densities follow a foot CT rescaled to [0, 1]:

    air 0 (exactly), fat 0.17, muscle 0.22, skin, tendon and cartilage 0.24, marrow 0.19, trabecular bone 0.3
    to 0.5, cortical bone 0.75 to 1; blood is 0.03 above the fat it runs in

The foot's 26 bones, two sesamoids, distal tibia and fibula are signed-distance solids. Each bone is
carved by its earlier neighbours, which makes congruent joint surfaces with a joint space of constant width. A
voxel holds its average to first order (partial volume), and textures are fixed in space, so sizes agree.

The anatomy is laid out in a frame in mm for a foot 260 mm long: y = 0 behind the heel, z = 0 under the sole,
x = 0 on the axis through the heel and the second toe.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.phantoms.solids import (
    Blend,
    Cone,
    Cube,
    Cut,
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

SIDE = 256.0  # mm
_SCALE = 0.93  # world mm per anatomical mm
_CENTRE = np.array([2.0, 131.0, 106.0])  # the cube's centre in the anatomical frame
FAT, MUSCLE, TENDON, SKIN, MARROW = 0.17, 0.22, 0.24, 0.24, 0.19

# Joints of the five toes, hallux first: head of the metatarsal, interphalangeal joints, tip.
_TOES = (
    ((-31, 197, 21), (-31, 229, 16), (-30, 250, 10)),
    ((-10, 206, 20), (-9, 232, 19), (-8.5, 245, 12), (-8, 256, 7)),
    ((7.5, 202, 19), (10, 226, 18), (11, 238, 11), (11.5, 248, 7)),
    ((24, 194, 18), (28, 216, 16), (29.5, 226.5, 10.5), (30, 236, 6.5)),
    ((39, 183, 15), (45, 202, 13.5), (47, 210.5, 9.5), (47.5, 219, 6.5)),
)
# Metatarsals: centre of the base, radii of base, shaft and head.
_METATARSALS = (
    ((-22, 153, 39), 11.5, 6.6, 10.3),
    ((-7, 148, 49), 8.3, 4.1, 7),
    ((8, 150, 44), 7.6, 3.8, 6.6),
    ((21, 133, 37), 7.6, 3.8, 6.4),
    ((34, 127, 26), 8, 3.9, 6.2),
)


@dataclass(frozen=True)
class Bone:
    """A bone's outline and what it is made of.

    Parameters
    ----------
    shaft : tuple or None
        (a, b): the axis of a long bone, which gets a thick cortex and a marrow cavity about its middle.
    cortex : float
        Thickness at the ends, mm.
    thick : float
        Thickness at mid-shaft, mm.
    gap : float
        Joint space to earlier bones, mm.
    """

    solid: Blend
    shaft: tuple | None = None
    cortex: float = 1.1
    thick: float = 2.0
    gap: float = 1.8


def _long(a: ArrayLike, b: ArrayLike, radii: tuple[float, float, float], thick=1.9, bow=0.0, flare=0.26) -> Bone:
    """A tapered long bone from the centre of its base to the centre of its head.

    Parameters
    ----------
    radii : tuple[float, float, float]
        Radii of base, shaft and head, mm.
    bow
        Rise at mid-shaft, mm.
    flare
        The fraction of its length over which the base narrows to the shaft.
    """
    (base, shaft, head), start, end = radii, np.array(a, float), np.array(b, float)

    def at(t):
        return tuple(start + t * (end - start) + [0, 0, 4 * bow * t * (1 - t)])

    parts = (
        Cone(at(0), at(flare), base, shaft * 1.05),
        Cone(at(flare), at(0.5), shaft * 1.05, shaft),
        Cone(at(0.5), at(0.8), shaft, shaft * 1.08),
        Cone(at(0.74), at(0.93), shaft, head * 0.86),
        Ellipsoid(at(1), (head, head * 0.96, head)),
    )
    return Bone(Blend(parts, 3.0), (at(0), at(1)), 0.9, thick)


def bones() -> list[Bone]:
    """The skeleton in the order in which joints are carved: the convex partner of a joint first."""
    out = [
        Bone(
            Blend(
                (  # calcaneus
                    Ellipsoid((4, 26, 33), (13.5, 14, 20), yaw_pitch_roll(pitch=-18)),
                    Cone((4, 30, 36), (9, 62, 41), 15, 12.5),
                    Cone((9, 60, 41), (17, 84, 36), 12.5, 11.5),
                    Ellipsoid((6, 59, 46), (12, 14, 9)),
                    Cone((2, 66, 47), (-14, 71, 47), 7, 5.5),
                    Cone((-3, 22, 18), (-1, 30, 19), 6.5, 5),
                ),
                6.0,
            )
        ),
        Bone(
            Blend(
                (  # talus
                    Cut(Cylinder((-2, 68, 66), 20, 14.5, 4.5), (-2, 68, 59), (0, -0.2, 0.98), 6.0),
                    Cone((-3, 80, 66), (-12, 100, 57), 11.5, 12.2),
                    Cone((-2, 54, 62), (-1, 46, 58), 8, 5),
                    Cone((4, 66, 60), (14, 67, 57), 8, 5),
                ),
                5.0,
            )
        ),
        Bone(
            Blend(
                (  # tibia
                    Cone((-4, 66, 285), (-4, 66, 140), 12.5, 11.5),
                    Cone((-4, 66, 140), (-4, 67, 112), 11.5, 16),
                    RoundedBox((-4, 67, 98), (19, 18, 13), 8, yaw_pitch_roll(yaw=8)),
                    Cone((-20, 66, 98), (-23.5, 67, 77), 9.5, 6),
                ),
                7.0,
            ),
            ((-4, 66, 320), (-4, 66, 95)),
            1.1,
            3.6,
            2.4,
        ),
        Bone(
            Blend(
                (  # fibula
                    Cone((21, 52, 285), (22, 55, 120), 6, 6.2),
                    Cone((22, 55, 120), (24, 59, 88), 6.2, 9),
                    Cone((24, 59, 88), (24, 59, 68), 9, 6),
                ),
                4.0,
            ),
            ((21, 52, 320), (24, 59, 75)),
            1.1,
            2.3,
            1.9,
        ),
        Bone(
            Blend(
                (  # navicular
                    Ellipsoid((-13, 117, 54), (19.5, 10.5, 14.5), yaw_pitch_roll(yaw=6, roll=-28)),
                    Cone((-24, 114, 47), (-33, 111, 43), 8.5, 6),
                ),
                5.0,
            )
        ),
        Bone(
            Blend(
                (  # cuboid: medially longest
                    RoundedBox((17, 110, 32), (10, 17, 11), 7.5, yaw_pitch_roll(yaw=-8, pitch=-8, roll=18)),
                    Ellipsoid((25, 108, 29), (9, 12, 10), yaw_pitch_roll(yaw=-18)),
                    Cone((12, 106, 23), (26, 112, 21), 5, 4),
                ),
                6.0,
            ),
            gap=2.0,
        ),
        # medial cuneiform: widest below
        Bone(
            Blend(
                (
                    RoundedBox((-22, 138, 44), (6.5, 12, 12), 6, yaw_pitch_roll(yaw=4, roll=16)),
                    Ellipsoid((-23, 137, 34), (8.5, 11.5, 8.5)),
                ),
                6.0,
            )
        ),
        Bone(
            Blend(
                (  # intermediate: a wedge
                    RoundedBox((-6, 133, 53), (7.5, 9, 7), 5),
                    Ellipsoid((-5.5, 133, 44), (5, 8, 8)),
                ),
                5.0,
            )
        ),
        Bone(
            Blend(
                (  # lateral: a wedge
                    RoundedBox((8, 135, 48), (7.5, 11, 7.5), 5.5, yaw_pitch_roll(yaw=-5, roll=8)),
                    Ellipsoid((8, 134, 38), (5.5, 9, 8.5)),
                ),
                5.0,
            )
        ),
    ]
    for (base, rb, rs, rh), toe in zip(_METATARSALS, _TOES):
        bone = _long(base, toe[0], (rb, rs, rh), thick=1.9 if rs < 6 else 2.4, bow=2.0)
        extra = ()
        if rs > 6:  # the plantar ridge between the sesamoids' grooves
            extra = (Cone((-31, 193, 15), (-31, 197, 14), 5, 4),)
        elif base == _METATARSALS[4][0]:
            extra = (Cone(base, (40, 117, 21), 6.5, 4.5),)  # the styloid process
        out.append(replace(bone, solid=Blend(bone.solid.parts + extra, 3.0)))
    for x, y in ((-37.5, 193), (-24.5, 194)):
        out.append(Bone(Blend((Ellipsoid((x, y, 9.2), (4.6, 6.2, 3.6)),), 0), cortex=0.8, gap=1.4))
    for i, (toe, meta) in enumerate(zip(_TOES, _METATARSALS)):
        size = meta[3]
        for j, (p, q) in enumerate(zip(toe[:-1], toe[1:])):
            p, q = np.array(p, float), np.array(q, float)
            along = (q - p) / np.linalg.norm(q - p)
            last = j == len(toe) - 2
            r = size * ((0.9, 0.68) if len(toe) == 3 else (0.84, 0.64, 0.5))[j]
            start = p + along * (size * 1.1 + r * 0.55 if j == 0 else r * 1.15)
            if not last:
                bone = _long(
                    start, q - along * r * 0.78, (r, r * 0.62, r * 0.78), 1.4 if i else 1.9, bow=0.4, flare=0.42
                )
            else:  # the distal phalanx ends in a spade-shaped tuft
                tip = q - along * r * 0.3
                tuft = Ellipsoid(tip, (r * 0.82, r * 0.42, r * 0.5))
                bone = Bone(
                    Blend(
                        (
                            Cone(tuple(start), tuple(start + 0.75 * (tip - start)), r, r * 0.48),
                            Cone(tuple(start), tuple(tip), r * 0.5, r * 0.45),
                            tuft,
                        ),
                        1.6,
                    ),
                    cortex=0.9,
                )
            out.append(replace(bone, gap=1.5 if i else 1.7))
    return out


def _skin(grid: Cube) -> np.ndarray:
    """Signed distance to the skin."""
    parts = [
        # shin
        tube([(-2, 66, 290), (-1, 66, 200), (-1, 67, 130), (-2, 68, 95)], [36, 31, 27, 26], smooth=3),
        # fibular side
        tube([(10, 58, 290), (12, 57, 190), (13, 58, 120), (15, 59, 90)], [34, 26, 20, 17], smooth=3),
        # calf, Achilles tendon
        tube([(4, 40, 290), (3, 43, 200), (2, 42, 135), (2, 38, 85), (3, 32, 45)], [38, 29, 20, 18, 23], smooth=3),
        Ellipsoid((-24, 66, 82), (11, 14, 17)),
        Ellipsoid((24, 59, 76), (10, 14, 18)),  # malleoli
        Ellipsoid((3, 29, 27), (28, 28, 30)),  # heel
        Cone((0, 70, 90), (-4, 92, 58), 30, 27),
        # medial column
        tube([(-8, 92, 52), (-17, 140, 40), (-30, 192, 22)], [27, 21.5, 17.5], smooth=3),
        tube([(-14, 70, 45), (-22, 108, 45), (-25, 140, 38)], [22, 19.5, 17], smooth=3),
        # lateral column
        tube([(10, 60, 36), (17, 90, 35), (29, 125, 27), (38, 178, 18)], [27, 25, 21, 15], smooth=3),
        Ellipsoid((-29, 191, 17), (18, 21, 18)),
        Ellipsoid((36, 182, 15), (16, 19, 15.5)),  # ball
        tube([(0, 90, 54), (-5, 140, 46), (-10, 200, 22)], [27, 21, 15], smooth=3),
        tube([(2, 90, 48), (10, 145, 40), (8, 198, 20), (24, 190, 19)], [25, 20, 15, 14], smooth=3),
    ]
    d = union(grid, parts, 12.0, 30.0)
    toes = np.full(grid.shape, 30, np.float32)
    for i, toe in enumerate(_TOES):
        r = (11.8, 12, 9.8) if i == 0 else (8.6, 7.6, 7.8, 6.6) if i < 3 else (8.4, 7.2, 7.2, 6.2)
        pulp = Ellipsoid(np.array(toe[-1]) + [0, -3, 2], (11, 12, 9) if i == 0 else (7.3, 7.5, 6.8))
        toe = Blend((tube(toe, r), pulp), 3.0)
        near = grid.near(toe, 12)
        if near is not None:
            where, p = near
            toes[where] = np.minimum(toes[where], toe(*p))
    d = smooth_min(d, toes, 5.0)
    # The sole: flat under heel, ball and lateral edge, raised under the medial arch.
    x, y, z = grid.at((slice(None),) * 3)
    arch = 17 * np.exp(-(((y - 105) / 42) ** 2)) / (1 + np.exp((x - 4) / 9)) + 3 * np.exp(-(((y - 100) / 45) ** 2))
    toe_roll = 9 * np.exp((y - 262) / 8) + 6 * np.exp(-(y + 4) / 8)
    return smooth_max(d, arch + toe_roll - z, 7.0)


def _muscles():
    """Muscle bellies (k, solid): leg compartments, plantar layers, interossei, short extensor."""
    # tibialis, extensors
    leg = (
        ((-9, 87, 290), (-13, 85, 150), 15, 9),
        ((8, 86, 290), (8, 86, 130), 13, 7),
        # peroneals, soleus
        ((29, 66, 290), (27, 52, 125), 11, 6),
        ((4, 30, 290), (3, 39, 155), 27, 9),
        # deep flexors, FHL
        ((-18, 48, 290), (-17, 49, 120), 13, 7),
        ((9, 48, 290), (8, 47, 108), 13, 9),
    )
    sole = (
        ((-8, 40, 16), (-16, 130, 20), 8, 5),
        ((2, 38, 13), (0, 150, 17), 8.5, 6),
        ((20, 38, 13), (35, 150, 14), 7.5, 4.5),
        ((-24, 60, 30), (-36, 165, 20), 8.5, 5),
        ((-2, 62, 24), (-2, 125, 26), 9, 7),
        ((-20, 140, 22), (-26, 178, 14), 7, 6),
        ((18, 84, 54), (12, 125, 58), 7, 4),
        ((28, 140, 17), (33, 172, 12), 6, 4),
        ((-12, 165, 25), (10, 160, 24), 6, 5),
    )
    between = []
    for (a, *_), (b, *_), ta, tb in zip(_METATARSALS[:-1], _METATARSALS[1:], _TOES[:-1], _TOES[1:]):
        p, q = (np.array(a) + b) / 2, (np.array(ta[0]) + tb[0]) / 2
        between.append((tuple(p + 0.2 * (q - p) - [0, 0, 3]), tuple(p + 0.85 * (q - p) - [0, 0, 1]), 5.5, 4))
    return [Cone(a, b, ra, rb) for a, b, ra, rb in (*leg, *sole, *between)]


def _tendons():
    """Achilles tendon, extensor and flexor tendons, plantar fascia."""
    out = [tube([(4, 26, 215), (4, 27, 165), (3, 28, 110), (3, 22, 66), (3, 17, 44)], [3, 5, 4.2, 4.6, 6], smooth=3)]
    ankle = np.array([2, 92, 105])
    for i, toe in enumerate(_TOES):
        head = np.array(toe[0], float)
        top = head + [0, 0, (12.5, 9.5, 9, 8.5, 8)[i]]
        middle = np.array([-10 + 8 * i, 138, (63, 66, 62, 55, 45)[i]], float)
        out.append(
            tube(
                [(2 * i, 88, 190), ankle + [2 * i - 6, 0, 0], middle, top, np.array(toe[1]) + [0, 0, 6]],
                [2, 2, 1.7, 1.6, 1.2],
            )
        )
        out.append(
            tube(
                [
                    (-17, 74, 42),
                    (-8 + 2 * i, 120, 27),
                    head - [0, 8, (15, 11, 10.5, 10, 9)[i]],
                    np.array(toe[1]) - [0, 2, 7],
                ],
                [2.2, 2, 1.7, 1.3],
            )
        )
        out.append(tube([(-3, 28, 10), (-1 + (i - 2) * 4, 90, 12 + (4 - i) * 1.5), head - [0, 10, 12]], [3, 2, 1.2]))
    # tibialis anterior
    out.append(tube([(-14, 88, 190), (-20, 94, 95), (-28, 126, 48)], [3, 2.6, 2.4]))
    # tibialis posterior
    out.append(tube([(-20, 54, 150), (-27, 58, 90), (-32, 84, 55), (-34, 108, 44)], [2.5] * 4))
    # peroneus brevis
    out.append(tube([(29, 46, 150), (29, 48, 80), (28, 66, 50), (38, 114, 25)], [2.5] * 4))
    return out


def _vessels(rng):
    """The named arteries and veins with random branches."""
    trunks = (
        ((-8, 86, 240), (-6, 92, 110), (-9, 122, 68), (-14, 165, 46), (-20, 195, 36)),
        ((-20, 46, 240), (-25, 46, 95), (-21, 62, 40), (-14, 105, 24), (8, 150, 20), (20, 172, 18)),
        ((-30, 78, 240), (-33, 82, 95), (-30, 120, 62), (-28, 170, 43), (-24, 205, 34)),
        ((24, 32, 240), (31, 42, 80), (38, 80, 44), (34, 130, 44), (28, 175, 33)),
        ((-28, 170, 43), (-10, 178, 44), (12, 172, 42), (30, 158, 36)),
    )
    out = []
    for trunk in trunks:
        points = np.array(trunk, float)
        radii = np.linspace(1.4, 0.8, len(points))
        out += tube(points, radii).parts
        for p, q in zip(points[:-1], points[1:]):
            for _ in range(3):
                side = np.cross(q - p, rng.normal(size=3))
                way = (q - p) / np.linalg.norm(q - p) + side / np.linalg.norm(side)
                out += branches(rng, p + rng.uniform(0.1, 0.9) * (q - p), way, 16, 0.8, 3)
    return out


def build(size: int, seed: int) -> tuple[np.ndarray, float, None]:
    """Data float32 [size]^3 in [0, 1], side in mm, and no analytic form (see `phantoms.make`)."""
    rng = np.random.default_rng(seed)
    side = SIDE / _SCALE
    grid = Cube(size, side, _CENTRE - side / 2)
    step = side / 256
    trabecular = Texture(rng, 72 * step, step, (0.55, 0.95, 0.55))
    flesh = Texture(rng, 64 * 2 * step, 2 * step, (2.2, 3.2, 2.8))

    # Soft tissue varies slowly: a lattice of fixed 2 mm keeps it cheap and independent of the size.
    coarse = Cube(128, side, grid.origin)
    skin = _skin(coarse)
    mottle = flesh(coarse)
    tissue = np.float32(FAT) + np.float32(0.006) * mottle
    for m in _muscles():
        coarse.paint(tissue, m, lambda where: MUSCLE + np.float32(0.009) * mottle[where], 2.5)
    # The fat under the skin is never muscle.
    fat = np.float32(FAT) + np.float32(0.008) * mottle
    tissue += np.clip((skin + np.float32(4.5)) / 3, 0, 1) * (fat - tissue)
    image, skin = subdivide(tissue, grid), subdivide(skin, grid)
    for t in _tendons():
        grid.paint(image, t, TENDON)
    for v in _vessels(rng):
        near = grid.near(v, grid.h)
        if near is not None:
            where, p = near
            # A vessel thinner than a voxel keeps its mass, not its full contrast.
            c = grid.cover(v(*p)) * min(1.0, 2 * min(v.ra, v.rb) / grid.h)
            image[where] += c * np.maximum(np.float32(FAT + 0.03) - image[where], 0)

    nearest = np.full(grid.shape, 12, np.float32)  # distance to the bones so far
    bone, part = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    for b in bones():
        _add_bone(grid, b, trabecular, flesh, nearest, bone, part)
    # Cartilage and periosteum: 2 mm around the bones.
    capsule = np.clip(np.float32(1.5) - nearest / 2, 0, 1)
    image += capsule * (np.maximum(image, np.float32(0.225)) - image)

    image += grid.cover(-skin - np.float32(1.7)) * (np.float32(SKIN) - image)
    image *= 1 - part
    image += bone
    image *= grid.cover(skin)
    return np.clip(image, 0, 1, out=image), SIDE, None


def _add_bone(grid, b: Bone, trabecular, relief, nearest, bone, part):
    """Carve a bone by the earlier ones; add its density to `bone`, its cover to `part`; update `nearest`."""
    near = grid.near(b.solid, 6.0)
    if near is None:
        return
    where, (x, y, z) = near
    bumps, texture = relief(grid, where), trabecular(grid, where)
    middle = np.float32(0)
    if b.shaft is not None:
        p, q = (np.array(e, np.float32) for e in b.shaft)
        axis = (q - p) / ((q - p) @ (q - p))
        s = (x - p[0]) * axis[0] + (y - p[1]) * axis[1] + (z - p[2]) * axis[2]
        middle = np.exp(-((np.abs(s - np.float32(0.5)) / np.float32(0.36)) ** 4))
    # Shafts are smooth, ends are rough.
    d = b.solid(x, y, z) + (np.float32(0.45) - np.float32(0.37) * middle) * bumps
    d = smooth_max(d, np.float32(b.gap) - nearest[where], 1.2)
    thickness = np.float32(b.cortex) + np.float32(b.thick - b.cortex) * middle
    # Trabeculae thin out from the cortex inwards, and leave a cavity inside a shaft.
    depth = np.clip(-d / 14, 0, 1)
    spongy = np.float32(0.43) - np.float32(0.10) * depth + np.float32(0.085) * texture + np.float32(0.02) * bumps
    spongy += middle * (np.float32(MARROW) + np.float32(0.015) * texture - spongy)
    # The cortex does not end sharply: it opens into the trabeculae over 1.2 mm.
    inner = np.clip(np.float32(0.5) - (d + thickness + np.float32(0.4)) / max(np.float32(1.2), grid.h), 0, 1)
    hard = np.float32(0.80) + np.float32(0.13) * middle + np.float32(0.03) * texture
    value = hard + inner * (spongy - hard)
    # Bones are disjoint: in a voxel that two of them touch their covers add up.
    c = np.minimum(grid.cover(d), 1 - part[where])
    bone[where] += c * value
    part[where] += c
    nearest[where] = np.minimum(nearest[where], d)
