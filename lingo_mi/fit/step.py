"""One step of the fit: render, compare, differentiate, and move the Gaussians."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fit import losses
from lingo_mi.fit.device import DeviceState, uploaded
from lingo_mi.fit.model import RENEWED, model_of, trusted, weights_of
from lingo_mi.fit.poses import Poses, gathered, place
from lingo_mi.fit.scatter import RENEWED as SCATTER_RENEWED
from lingo_mi.fit.scatter import light
from lingo_mi.fit.settings import Settings
from lingo_mi.fit.view import Target, differentiate, differentiate_replayed, evaluate, footprints_of, integrals
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.backprop import leaves, pass_on
from lingo_mi.projectors.objects import Ellipsoids
from lingo_mi.projectors.view import View, vector64
from lingo_mi.projectors.voxelize import Grid, voxelize
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.scan import Scan


def _targets(scan, unit, settings):
    weights = weights_of(scan, settings)
    return [Target.of(scan, i, unit, weights) for i in range(len(scan))]


class Stepper:
    """Steps of a fit on one scan with one set of settings."""

    def __init__(self, scan: Scan, settings: Settings, unit: float | None = None):
        """unit: the density that counts as 1, where another scan than this one decides it (`density_unit`)."""
        self.settings, self.geometry = settings, scan.geometry
        scan = trusted(scan, settings)
        self.unit = density_unit(scan, settings) if unit is None else unit
        self.model = model_of(scan, settings, self.unit)
        self.share = None  # of the second of two materials in every Gaussian, as the steps know it
        self.scattered = None  # what `Scattered.estimate` gave, as the steps know it
        self.targets = _targets(scan, self.unit, settings)
        self.coarse_until = round(settings.coarse_share * settings.iterations)
        self.coarse = _targets(scan.binned(2), self.unit, settings) if self.coarse_until else []
        self.half = scan.geometry.half
        # A fan beam in one plane says nothing about the direction across: nothing moves or turns out of the plane.
        self.flat = scan.geometry.nVoxel[2] == 1
        self.poses = Poses(len(scan), self.flat) if max(settings.rate_pose) > 0 else None

    def step(self, state: DeviceState, views, iteration: int, rng):
        """Advance the state by one Adam step on the given views; returns the loss, Float [1], not yet evaluated.

        iteration counts from 0. rng places the total variation's cube.
        """
        s = self.settings
        if self.share is None or iteration % RENEWED == 0 or dr.width(self.share) != len(state):
            self.share = self.shares(state)
        if (
            self.model is not None
            and self.model.scattered
            and iteration in {round(x * s.iterations) for x in SCATTER_RENEWED}
        ):
            self.scatter(state)
        for value in state.values.values():
            dr.enable_grad(value)
        gaussians = state.gaussians(s)
        # Each view and the cube add their derivatives to these; then one pass takes them to the raw parameters.
        leaf = leaves(gaussians)
        total = mi.Float(0)
        targets = self.coarse if iteration < self.coarse_until else self.targets
        for view in views:
            target = targets[view]
            if self.poses is not None:
                frames = self.poses.correct(target.frames, view)
                place(target.view, frames)
            loss, norm, visible = self._view(leaf, target, len(views))
            total += loss
            state.gradient += norm
            state.seen += visible
            if self.poses is not None:
                self.poses.step(view, frames, gathered(target.view), s.rate('pose', iteration), s)
        if s.lambda_tv > 0:
            total += self._total_variation(leaf, rng)
        pass_on(gaussians, map(dr.grad, leaf))
        gradients = {name: dr.grad(value) for name, value in state.values.items()}
        if self.flat:
            gradients['centre'].z, gradients['scale'].z = 0, 0
            gradients['rotation'].x, gradients['rotation'].y = 0, 0
        if 'harmonics' in gradients:  # those of a degree that has not joined in stay at zero
            joined = [dr.opaque(mi.Float, float((iteration + 1) // s.sh_every >= k)) for k in range(1, s.sh_degree + 1)]
            for i in range(len(gradients['harmonics'])):
                gradients['harmonics'][i] *= joined[math.isqrt(i + 1) - 1]
        state.adam(gradients, s, iteration)
        return total

    def corrected(self) -> Geometry:
        """The scan's geometry with its views where the fit has put them: as given, where it left them alone."""
        return self.geometry if self.poses is None else self.poses.corrected(self.geometry)

    def render(self, state: DeviceState, geometry: Geometry, progress=None) -> np.ndarray:
        """What the scan's detector would see in a geometry, noise apart, float32 [view, v, u]: density times mm, or -ln of
        the expected signal where the fit models effects. Grey images of alpha compositing are taken for line integrals."""
        frames, (height, width) = geometry.normalised_rays(), geometry.nDetector
        gaussians, share = state.gaussians(self.settings), self.shares(state)

        scattered = [None] * len(geometry)
        if self.model is not None and self.model.scattered:
            found = self.model.scattered.estimate(self.cloud(state), geometry)
            scattered = [uploaded(image.ravel()) for image in light(found, geometry)]

        def along(rays):
            return integrals(footprints_of(gaussians, rays, self.settings), rays, self.settings, share)

        out = np.empty((len(geometry), height, width), np.float32)
        for i in range(len(geometry)):
            view = View.of(frames, i, height, width, panel=False)
            image = along(view)[0] if self.model is None else self.model.image(along, view, scattered[i])
            out[i] = image.numpy().reshape(height, width)
            if progress:
                progress(i + 1, len(geometry))
        return out * np.float32(self.unit / geometry.scale)

    def volume(self, state: DeviceState, geometry: Geometry | None = None) -> np.ndarray | None:
        """The cloud's density at the voxel centres of a geometry's grid, float32 [x, y, z] (default: of the scan's).

        The grid must be of the scan's size, whatever its voxels.
        None for alpha compositing: opacities and radiances are no attenuation.
        """
        if self.settings.render == 'alpha':
            return None
        g = geometry or self.geometry
        grid = Grid(vector64(-g.half), vector64(2 * g.half / g.nVoxel), g.nVoxel)
        values = voxelize(*state.gaussians(self.settings), grid, self.settings.extent, deep=True)
        return grid.volume(values) * np.float32(self.unit)

    def shares(self, state: DeviceState):
        """The second material's share in every Gaussian's density, Float [N]; None where the fit knows one material."""
        if self.model is None or self.model.split is None:
            return None
        return self.model.shares(
            self.volume(state), np.stack([c.numpy() for c in state.values['centre']], 1), self.half
        )

    def cloud(self, state: DeviceState) -> Ellipsoids:
        """The Gaussians in the world frame, mm, densities 1/mm."""
        centre, scale, rotation, density = (dr.detach(x) for x in state.gaussians(self.settings))
        size, middle = dr.opaque(mi.Float, self.geometry.scale), dr.opaque(mi.Point3f, self.geometry.offOrigin)
        return Ellipsoids.of(
            centre / size + middle,
            scale / size,
            rotation,
            density * dr.opaque(mi.Float, self.unit),
            self.shares(state),
            'cloud',
        )

    def arrays(self) -> dict:
        """What steps keep beside the state, by name, for a checkpoint."""
        share = {} if self.share is None else dict(share=self.share.numpy())
        scattered = {} if self.scattered is None else dict(scattered=self.scattered)
        return ({} if self.poses is None else self.poses.arrays()) | share | scattered

    def restore(self, arrays: dict):
        """Take over what `arrays` gave."""
        if self.poses is not None:
            self.poses.restore(arrays)
        if 'share' in arrays:
            self.share = uploaded(arrays['share'])
        if 'scattered' in arrays:
            self.scattered = arrays['scattered']
            self._show_scattered()

    def scatter(self, state: DeviceState):
        """Estimate anew what the cloud scatters into the views."""
        self.scattered = self.model.scattered.estimate(self.cloud(state), self.corrected())
        self._show_scattered()

    def _show_scattered(self):
        """Give all views the scattered light that is expected in them."""
        views = Scan(self.geometry, light(self.scattered, self.geometry))
        for targets, scan in ((self.targets, views), (self.coarse, views.binned(2))):
            for target, image in zip(targets, scan.projections):
                target.scattered = uploaded(image.ravel())

    def _view(self, leaf, target, batch):
        """`differentiate` a view: replayed, where nothing but line integrals from known poses is fitted."""
        if self.model is None and self.poses is None and self.settings.render != 'alpha':
            return differentiate_replayed(leaf, target, self.settings, batch)
        return differentiate(leaf, target, self.settings, batch, self.model, self.share)

    def _total_variation(self, gaussians, rng):
        """Add the gradient of the total variation of a cube at a random place (R2-Gaussian), its samples between the centres
        of the first and the last voxels."""
        s = self.settings
        voxel, between = 2 * self.half / self.geometry.nVoxel, np.array(self.geometry.nVoxel) - 1
        shape = tuple(int(min(s.tv_size, n // s.tv_stride + 1)) for n in between)
        room = between - (np.array(shape) - 1) * s.tv_stride
        corner = -self.half + (0.5 - 0.5 * s.tv_stride + rng.random(3) * room) * voxel
        voxel = voxel * s.tv_stride
        low, high = vector64(corner), vector64(corner + shape * voxel)
        with dr.suspend_grad():
            centre, scale = dr.detach(gaussians[0]), dr.detach(gaussians[1])
            reach = dr.max(scale) * s.extent
            near = dr.all((centre + reach > mi.Vector3f(low)) & (centre - reach < mi.Vector3f(high)))
            index = dr.compress(near)
        if dr.width(index) == 0:
            return mi.Float(0)
        chosen = [dr.gather(type(x), x, index, mode=dr.ReduceMode.NoConflicts) for x in gaussians]
        cube = voxelize(*chosen, Grid(low, vector64(voxel), shape), s.extent)
        loss = s.lambda_tv * losses.tv(cube, shape[::-1])
        dr.backward(loss)
        evaluate(gaussians)
        return dr.detach(loss)


def density_unit(scan: Scan, settings: Settings) -> float:
    """The density that a fit counts as 1: see `Settings.normalise`. Raises InputError for an empty scan."""
    require_signal(scan, 'fit')
    return float(scan.projections.max()) * scan.geometry.scale if settings.normalise else 1.0
