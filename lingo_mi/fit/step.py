"""One step of the fit: render, compare, differentiate, and move the Gaussians."""
from __future__ import annotations

import functools
import math
import operator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import InputError
from ..geometry import Geometry
from ..scan import Scan
from ..xray.alpha import composite, flatten
from ..xray.footprint import project
from ..xray.frame import View, vector64
from ..xray.objects import Ellipsoids
from ..xray.radiance import seen
from ..xray.splat import splat
from ..xray.voxelize import Grid, voxelize
from . import losses
from .device import DeviceState, uploaded
from .loss_scale import loss_scale
from .model import RENEWED, model_of, trusted, weights_of
from .poses import Poses, gathered, place
from .scattered import RENEWED as SCATTER_RENEWED, light
from .settings import Settings


class Target:
    """A measured view on the device: its rays, pixels (normalised line integrals over the fit's unit of density), which of
    them are valid (None: all), what they are multiplied by before they are compared (None: nothing), and the scattered light
    that is expected in them (None: none)."""

    def __init__(self, scan: Scan, index: int, unit: float, weights=None):
        height, width = scan.geometry.nDetector
        # The object lies between source and panel, so integrals need not end there; a Gaussian that grew to reach the
        # panel would otherwise leave the fast path.
        self.frames = scan.geometry.normalised_frames()[[index]]
        self.view = View.of(self.frames, 0, height, width, panel=False)
        pixels = scan.projections[index].ravel() * np.float32(scan.geometry.scale / unit)
        self.weights = None if weights is None else uploaded(weights[index].ravel())
        self.pixels = mi.Float(pixels if weights is None else pixels * weights[index].ravel())
        dr.eval(self.pixels)
        self.valid, self.scattered = None, None
        if scan.valid is not None and not scan.valid[index].all():
            self.valid = mi.Bool(scan.valid[index].ravel())
            dr.make_opaque(self.valid)

    def seen(self, image):
        """An image as this view compares it: weighted, and pixels that are not valid are zero, in it as in the measured one.

        To SSIM's windows they are then like the surroundings of the panel. Their derivatives vanish.
        """
        if self.weights is not None:
            image = image * self.weights
        return image if self.valid is None else dr.select(self.valid, image, 0)


def _targets(scan, unit, settings):
    weights = weights_of(scan, settings)
    return [Target(scan, i, unit, weights) for i in range(len(scan))]


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
        if self.model is not None and self.model.scattered and iteration in {round(x * s.iterations) for x in SCATTER_RENEWED}:
            self.scatter(state)
        for value in state.values.values():
            dr.enable_grad(value)
        gaussians = state.gaussians(s)
        # Each view and the cube add their derivatives to these; then one pass takes them to the raw parameters.
        leaf = _leaf(gaussians)
        total = mi.Float(0)
        targets = self.coarse if iteration < self.coarse_until else self.targets
        for view in views:
            target = targets[view]
            if self.poses is not None:
                frames = self.poses.correct(target.frames, view)
                place(target.view, frames)
            total += self._view(state, leaf, target, len(views))
            if self.poses is not None:
                self.poses.step(view, frames, gathered(target.view), s.rate('pose', iteration), s)
        if s.lambda_tv > 0:
            total += self._total_variation(leaf, rng)
        _pass_on(leaf, gaussians)
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
        frames, (height, width) = geometry.normalised_frames(), geometry.nDetector
        gaussians, share = state.gaussians(self.settings), self.shares(state)

        scattered = [None] * len(geometry)
        if self.model is not None and self.model.scattered:
            found = self.model.scattered.estimate(self.cloud(state), geometry)
            scattered = [uploaded(image.ravel()) for image in light(found, geometry)]

        def integrals(rays):
            return self._integrals(self._project(gaussians, rays), rays, share)
        out = np.empty((len(geometry), height, width), np.float32)
        for i in range(len(geometry)):
            view = View.of(frames, i, height, width, panel=False)
            image = integrals(view)[0] if self.model is None else self.model.image(integrals, view, scattered[i])
            out[i] = image.numpy().reshape(height, width)
            if progress:
                progress(i + 1, len(geometry))
        return out * np.float32(self.unit / geometry.scale)

    def volume(self, state: DeviceState) -> np.ndarray | None:
        """The cloud's density at the voxel centres of the scan's grid, float32 [x, y, z].

        None for alpha compositing: opacities and radiances are no attenuation.
        """
        if self.settings.render == 'alpha':
            return None
        g = self.geometry
        grid = Grid(vector64(-g.half), vector64(2 * g.half / g.nVoxel), g.nVoxel)
        values = voxelize(*state.gaussians(self.settings), grid, self.settings.extent, deep=True)
        return grid.volume(values) * np.float32(self.unit)

    def shares(self, state: DeviceState):
        """The second material's share in every Gaussian's density, Float [N]; None where the fit knows one material."""
        if self.model is None or self.model.split is None:
            return None
        return self.model.shares(self.volume(state), np.stack([c.numpy() for c in state.values['centre']], 1), self.half)

    def cloud(self, state: DeviceState) -> Ellipsoids:
        """The Gaussians in the world frame, mm, densities 1/mm."""
        centre, scale, rotation, density = (dr.detach(x) for x in state.gaussians(self.settings))
        size, middle = dr.opaque(mi.Float, self.geometry.scale), dr.opaque(mi.Point3f, self.geometry.offOrigin)
        return Ellipsoids.of(centre / size + middle, scale / size, rotation, density * dr.opaque(mi.Float, self.unit),
                             self.shares(state), 'cloud')

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

    def _project(self, gaussians, rays):
        """A cloud on a view's panel, `Footprints` or `Discs`, the last two of whose values are x and y in pixels."""
        if self.settings.render == 'alpha':
            centre, scale, rotation, opacity, *radiance = gaussians
            return flatten(centre, scale, rotation, opacity, seen(centre, rays, *radiance), rays)
        return project(*gaussians, rays, self.settings.extent)

    def _integrals(self, footprints, rays, share):
        """Line integrals along the rays of a view, a list of Float: of the cloud, or of each of its two materials; or the grey
        image that alpha compositing takes for them."""
        if self.settings.render == 'alpha':
            return [composite(footprints, rays.height, rays.width)]
        amplitude, *others = footprints.values
        parts = [amplitude] if share is None else [amplitude * (1 - share), amplitude * share]
        return [splat(replace(footprints, values=(part, *others)), rays.height, rays.width, self.settings.extent)
                * rays.lengths() for part in parts]

    def _view(self, state, gaussians, target, batch):
        """Add one view's gradient to the parameters', and its part to the densification statistic."""
        s, view = self.settings, target.view
        bundles = []  # of rays: one, or all those that the model takes a mean over

        def integrals(rays):
            footprints = self._project(gaussians, rays)
            leaf = _leaf(footprints.values)  # their derivatives are wanted themselves, for the statistic
            bundles.append((footprints, leaf))
            return self._integrals(replace(footprints, values=leaf), rays, self.share)
        image = integrals(view)[0] if self.model is None else self.model.image(integrals, view, target.scattered)
        loss = losses.combined(target.seen(image), target.pixels, view.height, view.width, s.lambda_ssim)
        factor = loss_scale(dr.detach(image)) if s.loss_scale != 'none' else mi.Float(1)
        weight = factor if s.loss_scale == 'dynamic' else mi.Float(1)
        # Bundles share what leads to a view's pose, so its edges must outlast all but the last.
        flags = dr.ADFlag.Default if len(bundles) == 1 else dr.ADFlag.ClearVertices
        dr.backward(loss * weight * (1 / batch), flags=flags)
        # Not while derivatives are suspended: they would read as zero.
        gx, gy = (functools.reduce(operator.add, [dr.grad(leaf[i]) for _, leaf in bundles]) for i in (-2, -1))
        footprints = bundles[len(bundles) // 2][0]
        with dr.suspend_grad():
            norm = dr.norm(mi.Vector2f(gx * (view.width / 2), gy * (view.height / 2))) * batch
            state.gradient += norm * factor if s.loss_scale == 'statistic' else norm
            state.seen += dr.select(footprints.seen, 1., 0.)
        for footprints, leaf in bundles:  # one by one: a kernel for all of them would take long to compile
            _pass_on(leaf, footprints.values, flags)
            _evaluate(gaussians)
        return dr.detach(loss) * (1 / batch)

    def _total_variation(self, gaussians, rng):
        """Add the gradient of the total variation of a cube at a random place (R2-Gaussian), its samples between the centres
        of the first and the last voxels."""
        s = self.settings
        voxel, between = 2 * self.half / self.geometry.nVoxel, np.array(self.geometry.nVoxel) - 1
        shape = tuple(int(min(s.tv_size, n // s.tv_stride + 1)) for n in between)
        room = between - (np.array(shape) - 1) * s.tv_stride
        corner = -self.half + (.5 - .5 * s.tv_stride + rng.random(3) * room) * voxel
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
        _evaluate(gaussians)
        return dr.detach(loss)


def density_unit(scan: Scan, settings: Settings) -> float:
    """The density that a fit counts as 1: see `Settings.normalise`. Raises InputError for an empty scan."""
    largest = float(scan.projections.max()) * scan.geometry.scale
    if largest <= 0:
        raise InputError('the projections are zero everywhere: there is nothing to fit')
    return largest if settings.normalise else 1.


def _leaf(values):
    """Copies that gather derivatives, cut off from what the values were made of."""
    copies = tuple(dr.detach(v) for v in values)
    dr.enable_grad(copies)
    return copies


def _pass_on(leaf, values, flags=dr.ADFlag.Default):
    """Propagate the derivatives gathered in a leaf through the making of its values."""
    for value, copy in zip(values, leaf):
        if dr.grad_enabled(value):
            dr.set_grad(value, dr.grad(copy))
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward, flags)


def _evaluate(values):
    """Evaluate all derivatives in one kernel; one by one, each would repeat the work that they share."""
    dr.eval([dr.grad(value) for value in values])
