"""Helpers of tests of geometry."""

import numpy as np

from lingo_mi.geometry.trajectories import rotation


class Ellipsoids:
    """Ellipsoids (centre, axes as columns [3, 3], density), whose line integrals are chords."""

    def __init__(self, bodies):
        self.bodies = bodies

    def moved(self, turn, shift):
        return Ellipsoids([(turn @ centre + shift, turn @ axes, density) for centre, axes, density in self.bodies])

    def image(self, frames, view, shape):
        x, y = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
        o, d = frames.through(view, x, y)
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        out = np.zeros(shape)
        for centre, axes, density in self.bodies:
            whiten = np.linalg.inv(axes).T
            p, q = (o - centre) @ whiten, d @ whiten
            qq, pq = (q * q).sum(-1), (p * q).sum(-1)
            out += 2 * density * np.sqrt(np.maximum(pq**2 - qq * ((p * p).sum(-1) - 1), 0)) / qq
        return out


BODIES = Ellipsoids(
    [
        (np.array([8.0, -3.0, 5.0]), np.diag([6.0, 4.0, 9.0]), 0.02),
        (np.array([-7.0, 6.0, -4.0]), rotation('x', 0.4)[0] @ rotation('z', 1.0)[0] @ np.diag([9.0, 2.0, 5.0]), 0.05),
    ]
)
