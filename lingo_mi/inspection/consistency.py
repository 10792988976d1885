"""Agreement of views with each other, without a reconstruction: data consistency conditions of the plane of the source.

Fan beam. For two sources, the line through them beside the object, and phi the angle of a ray to the line's normal,

    M = integral of p(phi) / cos(phi) d phi

is the same from both: it is the integral of the density over the distance from that line (Clackdoyle, Desbat: Data consistency
conditions for truncated fanbeam and parallel projections, Med. Phys. 2015, n = 0). Parallel beam: the centre of mass of the
view at the angle a is c + x cos(a) + y sin(a), and c is the axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEEPEST = np.radians(75)  # from the normal of the line: beyond, 1 / cos magnifies every error


@dataclass(frozen=True)
class Plane:
    """One row of every view in the plane of the source, air subtracted.

    Parameters
    ----------
    p : ndarray [n, u]
    angles : ndarray
        [n] radians.
    u : ndarray
        [u] mm, places of the pixels from the foot of the axis.
    DSD : float
        Mm; 0 for a parallel beam.
    """

    p: np.ndarray
    angles: np.ndarray
    u: np.ndarray
    DSD: float

    def subset(self, index: np.ndarray) -> Plane:
        return Plane(self.p[index], self.angles[index], self.u, self.DSD)


def disagreement(plane: Plane, angles: np.ndarray, shift: float = 0.0) -> tuple[float, np.ndarray]:
    """Root mean square disagreement of all views, and of each view [n].

    Fan beam: relative differences of M over all pairs. Parallel beam: distances of the centres of mass from the best curve with
    c = 0, over the half-width of the panel; nan if there are too few views.

    Parameters
    ----------
    shift : float
        Mm on the panel, added to the places of the pixels.
    """
    if not plane.DSD:
        return _parallel(plane, angles, shift)
    u = plane.u + shift
    gamma = np.arctan2(u, plane.DSD)
    step = np.gradient(u) * plane.DSD / (plane.DSD**2 + u**2)
    seen = plane.p.max(0) > 0.05 * plane.p.max()
    widest = np.abs(gamma[seen]).max() if seen.any() else 0.0
    apart = angles[None] - angles[:, None]
    half = (np.angle(np.exp(1j * apart)) / 2)[..., None]
    used = (np.abs(half[..., 0]) + widest < STEEPEST) & ~np.eye(len(angles), dtype=bool)
    weights = np.where(used[..., None], step / np.maximum(np.cos(half + gamma), np.cos(np.radians(89))), 0)
    M = np.einsum('iu,iju->ij', plane.p, weights)
    r = np.where(used, (M - M.T) / np.maximum(np.abs(M + M.T) / 2, 1e-12), 0)
    count = used.sum(1)
    each = np.sqrt((r**2).sum(1) / np.maximum(count, 1))
    return (float(np.sqrt((r**2).sum() / count.sum())) if count.sum() >= 3 else np.nan), each


def _parallel(plane, angles, shift):
    n = len(angles)
    if n < 5:
        return np.nan, np.full(n, np.nan)
    centre = plane.p @ (plane.u + shift) / plane.p.sum(1)
    curve = np.stack([np.cos(angles), np.sin(angles)], 1)
    off = centre - curve @ np.linalg.lstsq(curve, centre, rcond=None)[0]
    off /= np.ptp(plane.u) / 2
    return float(np.sqrt((off**2).mean())), np.abs(off)


def best_shift(plane: Plane, angles: np.ndarray, reach: float) -> tuple[float, float]:
    """The shift in mm, within +- reach, that lets the views agree best, and their disagreement then."""
    low, high = -reach, reach
    for _ in range(3):
        places = np.linspace(low, high, 13)
        values = np.array([disagreement(plane, angles, s)[0] for s in places])
        if not np.isfinite(values).all():
            return 0.0, np.nan
        i, step = int(np.argmin(values)), places[1] - places[0]
        low, high = places[i] - step, places[i] + step
    return float(places[i]), float(values[i])


def swapped(plane: Plane, angles: np.ndarray, shift: float) -> tuple[int, int] | None:
    """Two views that agree with the others twice as well in each other's place; None if there are no such."""
    difference, each = disagreement(plane, angles, shift)
    worst = np.argsort(each)[::-1][:6]
    best, pair = difference / 2, None
    for i in worst:
        for j in {*worst.tolist(), (i - 1) % len(angles), (i + 1) % len(angles)} - {int(i)}:
            order = np.arange(len(angles))
            order[[i, j]] = order[[j, i]]
            value = disagreement(plane.subset(order), angles, shift)[0]
            if value < best:
                best, pair = value, (min(int(i), int(j)), max(int(i), int(j)))
    return pair
