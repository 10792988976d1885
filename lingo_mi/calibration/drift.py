"""The panel's place as a function of time: a constant, and polynomials for a scanner that warms up. NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from lingo_mi.calibration.panel import Panel
from lingo_mi.geometry.base import Geometry

NEAR = 1e-6  # radians that count as zero


def scan_times(geometry: Geometry, angles: np.ndarray) -> np.ndarray:
    """The time of views at `angles` [m] radians, -1 for a scan's first view and 1 for its last: their place between its angles.

    The views of the scan are in the order of their time, at even intervals. If its angles turn back, or there is one view
    only, angles do not tell the time, and views are taken in their own order.
    """
    n = len(geometry)
    if len(angles) == n and np.array_equal(angles, geometry.angles):
        return np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
    scan_angles = np.asarray(geometry.angles, float)
    if not _in_order(scan_angles):
        scan_angles = np.unwrap(scan_angles)
    turns = np.diff(scan_angles)
    if n < 2 or not _in_order(scan_angles):
        return np.linspace(-1, 1, len(angles)) if len(angles) > 1 else np.zeros(len(angles))
    turned, x = np.abs(scan_angles - scan_angles[0]), np.sign(turns[0]) * (angles - scan_angles[0])
    if turned[-1] < 2 * np.pi:  # a view at an angle outside theirs came after the last
        x = np.mod(x + NEAR, 2 * np.pi) - NEAR
    elif x.min() < -NEAR or np.ptp(geometry.angles) < 2 * np.pi:  # these angles do not count the turns
        x = _counted(np.mod(x + NEAR, 2 * np.pi) - NEAR)
    step = 2 / (n - 1)
    ends = np.append(turned, turned[-1] + np.median(np.abs(turns)))
    return np.interp(x, ends, np.append(np.linspace(-1, 1, n), 1 + step))


def _counted(angles: np.ndarray) -> np.ndarray:
    """Angles of views in the order of their time, from [0, 2 pi), with as many turns added as each must have made: the fewest."""
    out = angles.copy()
    for i in range(1, len(out)):
        out[i] += 2 * np.pi * max(0.0, np.ceil((out[i - 1] - out[i]) / (2 * np.pi)))
    return out


def _in_order(angles: np.ndarray) -> bool:
    """Return whether the angles only rise or only fall."""
    turns = np.diff(angles)
    return bool(np.all(turns > 0) or np.all(turns < 0))


@dataclass(frozen=True)
class Drift:
    """The panel's place over a scan, v(t) = sum of v[k] P_k(t) with Legendre's polynomials P_k, u(t) likewise, and its yaw.

    Parameters
    ----------
    scan : Geometry
        The geometry whose views define the time t, -1 for the first view and 1 for the last.
    v, u : tuple[float, ...]
        [degree + 1] mm each: the constants first.
    yaw : float
        Radians.
    """

    scan: Geometry
    v: tuple[float, ...] = (0.0,)
    u: tuple[float, ...] = (0.0,)
    yaw: float = 0.0

    @classmethod
    def of(cls, scan: Geometry, numbers: dict[str, float]) -> Drift:
        """From numbers by name: v, v1, v2, ..., u, u1, ... and yaw; missing ones are 0."""
        degree = max((int(name[1:]) for name in numbers if name[1:].isdigit()), default=0)
        v, u = (tuple(numbers.get(f'{axis}{k or ""}', 0.0) for k in range(degree + 1)) for axis in 'vu')
        return cls(scan, v, u, numbers.get('yaw', 0.0))

    @property
    def constant(self) -> bool:
        """True if all views have the panel in the same place."""
        return not any(self.v[1:]) and not any(self.u[1:])

    def panel(self, geometry: Geometry) -> Panel:
        """The panel in the views of a geometry. They may be other views than the scan's, taken during the scan."""
        if self.constant:
            return Panel(self.v[0], self.u[0], self.yaw)
        t = scan_times(self.scan, geometry.angles)
        return Panel(legendre.legval(t, self.v), legendre.legval(t, self.u), self.yaw)
