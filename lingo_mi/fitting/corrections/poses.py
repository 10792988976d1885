"""Poses of the views, corrected together with the cloud: a rigid motion of source and panel for every view.

A view's correction turns source and panel about the volume's centre and shifts them. The six numbers are found by Adam
(Kingma and Ba 2015) in the tangent space. A step d turns the current view by exp([d1 d2 d3]) and then shifts it by
(d4 d5 d6). The derivatives are therefore always taken at zero rotation:

    d loss / d turn  = sum over source, corner, u, v of  x cross (d loss / d x)
    d loss / d shift = d loss / d source + d loss / d corner

`Rays.by_motion` computes these. A common motion of all views equals a motion of the object; the projections do not determine
it. So after every step the mean turn and the mean shift of all views are subtracted. Corrections may be restricted to cubic
polynomials in time, which hold what a single view tells poorly.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from lingo_mi.calibration.drift import scan_times
from lingo_mi.calibration.response.part import SMOOTH
from lingo_mi.fitting.corrections.correction import CorrectedFit, Correction
from lingo_mi.fitting.options.rates import Rates
from lingo_mi.fitting.view_loss import MeasuredView
from lingo_mi.geometry.base import Geometry
from lingo_mi.geometry.rays import Rays
from lingo_mi.projectors.view import View, vector64

_NAMES = ('source', 'corner', 'u', 'v')


class Poses:
    """Corrections of n views, in the normalised frame.

    Attributes
    ----------
    turn
        [n, 3] rotation vectors, radians.
    shift
        [n, 3], in units of half the volume's longest side.
    first, second, steps
        Adam's moments [n, 6] and number of steps [n] of every view.
    """

    def __init__(self, n: int, flat: bool = False, smooth: bool = False):
        """flat: True for a fan beam, whose views turn about z and shift in their plane only.

        smooth: True for corrections that are cubic polynomials in time, from the first view to the last.
        """
        self.projection = None
        if smooth:
            basis = np.linalg.qr(legendre.legvander(np.linspace(-1, 1, n), min(SMOOTH, n - 1)))[0]
            self.projection = basis @ basis.T
        self.turn, self.shift = np.zeros((n, 3)), np.zeros((n, 3))
        self.first, self.second, self.steps = np.zeros((n, 6)), np.zeros((n, 6)), np.zeros(n, int)
        self.free = np.array([0, 0, 1, 1, 1, 0] if flat else [1] * 6, float)

    def arrays(self) -> dict:
        """All numbers by name, for a checkpoint."""
        return {f'poses.{k}': getattr(self, k) for k in ('turn', 'shift', 'first', 'second', 'steps')}

    def restore(self, arrays: dict) -> None:
        """Restore the output of `arrays`."""
        for name in self.arrays():
            setattr(self, name.removeprefix('poses.'), np.array(arrays[name]))

    def correct(self, rays: Rays, view: int | None = None) -> Rays:
        """The corrected views, normalised frame. With `view`, `rays` holds that one view [1] and only it is corrected."""
        chosen = slice(None) if view is None else [view]
        return rays.moved(Rotation.from_rotvec(self.turn[chosen]).as_matrix(), self.shift[chosen])

    def corrected(self, geometry: Geometry) -> Geometry:
        """A scan's geometry, in mm, with corrected views."""
        g, centre = geometry, np.array(geometry.grid.centre)
        f = self.correct(g.normalised_rays(curved=True))
        source = f.source if f.parallel else f.source / g.grid.scale + centre
        rays = replace(
            f, source=source, corner=f.corner / g.grid.scale + centre, u=f.u / g.grid.scale, v=f.v / g.grid.scale
        )
        return Geometry.from_poses(rays, g.nDetector, grid=g.grid)

    def between(self, scan: Geometry, geometry: Geometry) -> Geometry:
        """A geometry with smooth corrections for the time of its views, which were taken during the scan.

        It is returned unchanged if each view has its own correction: these say nothing about other views.
        """
        if self.projection is None:
            return geometry
        t, knots = scan_times(scan, geometry.angles), np.linspace(-1, 1, len(self.turn))
        there = Poses(len(geometry))
        for name in ('turn', 'shift'):
            values = getattr(self, name)
            setattr(there, name, np.stack([np.interp(t, knots, column) for column in values.T], 1))
        return there.corrected(geometry.on(scan.grid))

    def step(self, view: int, rays: Rays, gradient: np.ndarray, rate: float, adam: Rates) -> None:
        """Move a view by one Adam step, then subtract the mean motion of all views.

        Parameters
        ----------
        rays : Rays
            The view with the corrections so far, [1].
        gradient : ndarray
            Derivatives of the loss by its source, corner, u and v, [4, 3].
        """
        g = rays.by_motion(gradient[None])[0] * self.free
        b1, b2 = adam.beta1, adam.beta2
        self.steps[view] += 1
        self.first[view] = b1 * self.first[view] + (1 - b1) * g
        self.second[view] = b2 * self.second[view] + (1 - b2) * g * g
        m = self.first[view] / (1 - b1 ** self.steps[view])
        v = self.second[view] / (1 - b2 ** self.steps[view])
        move = -rate * m / (np.sqrt(v) + adam.epsilon)
        by = Rotation.from_rotvec(move[:3])
        self.turn[view] = (by * Rotation.from_rotvec(self.turn[view])).as_rotvec()
        self.shift[view] = by.apply(self.shift[view]) + move[3:]  # turns are about the origin, so the shift turns too
        if self.projection is not None:  # of small turns, whose vectors add
            self.turn, self.shift = self.projection @ self.turn, self.projection @ self.shift
        back = Rotation.from_rotvec(-self.turn.mean(0))
        self.turn = (back * Rotation.from_rotvec(self.turn)).as_rotvec()
        self.shift = back.apply(self.shift)
        self.shift -= self.shift.mean(0)


def place(view: View, rays: Rays) -> None:
    """Set a `View`'s pose to the pose of `rays` [1] and enable its gradients."""
    for name in _NAMES:
        vector = vector64(getattr(rays, name)[0])
        dr.enable_grad(vector)
        setattr(view, name, vector)


def gathered(view: View) -> np.ndarray:
    """The accumulated derivatives by a view's source, corner, u and v, [4, 3]. Waits for the device."""
    return np.array([[float(c[0]) for c in dr.grad(getattr(view, name))] for name in _NAMES])


class PoseCorrection(Correction):
    """Moves every view by one Adam step after its image was compared.

    Parameters
    ----------
    poses : Poses
        The corrections so far.
    rates : tuple[float, float]
        (first, last): radians, and units of half the volume's longest side.
    """

    moves_views = True

    def __init__(self, poses: Poses, rates: tuple[float, float]):
        self.poses, self.rates = poses, rates

    def before_view(self, fit: CorrectedFit, target: MeasuredView, view: int) -> None:
        place(target.view, self.poses.correct(target.rays, view))

    def after_view(self, fit: CorrectedFit, target: MeasuredView, view: int, iteration: int) -> None:
        rays, rate = self.poses.correct(target.rays, view), fit.method.falling(self.rates, iteration)
        self.poses.step(view, rays, gathered(target.view), rate, fit.method.rates)

    def corrected(self, geometry: Geometry) -> Geometry:
        return self.poses.corrected(geometry)

    def between(self, scan: Geometry, geometry: Geometry) -> Geometry:
        return self.poses.between(scan, geometry)

    def arrays(self) -> dict[str, np.ndarray]:
        return self.poses.arrays()

    def restore(self, fit: CorrectedFit, arrays: dict[str, np.ndarray]) -> None:
        self.poses.restore(arrays)
