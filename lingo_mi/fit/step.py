"""One step of the fit: render, compare, differentiate, and move the Gaussians."""
from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import Geometry
from ..scan import Scan
from ..xray.footprint import project
from ..xray.frame import View, vector64
from ..xray.splat import splat
from ..xray.voxelize import Grid, voxelize
from . import losses
from .device import DeviceState
from .settings import Settings


class Target:
    """A measured view on the device: its rays, pixels (normalised line integrals) and what SSIM needs of them."""

    def __init__(self, scan: Scan, index: int):
        height, width = scan.geometry.nDetector
        # The object lies between source and panel, so integrals need not end there; a Gaussian that grew to reach the
        # panel would otherwise leave the fast path.
        self.view = View.of(scan.geometry.normalised_frames(), index, height, width, panel=False)
        self.pixels = mi.Float(scan.normalised[index].ravel())
        self.ssim = losses.ssim_target(self.pixels, height, width)
        dr.eval(self.pixels, self.ssim)


class Stepper:
    """Steps of a fit on one scan with one set of settings."""

    def __init__(self, scan: Scan, settings: Settings):
        self.settings, self.geometry = settings, scan.geometry
        self.targets = [Target(scan, i) for i in range(len(scan))]
        self.half = scan.geometry.half
        # A fan beam in one plane says nothing about the direction across: nothing moves or turns out of the plane.
        self.flat = scan.geometry.nVoxel[2] == 1

    def step(self, state: DeviceState, views, iteration: int, rng):
        """Advance the state by one Adam step on the given views; returns the loss, Float [1], not yet evaluated.

        iteration counts from 0. rng places the total variation's cube.
        """
        s = self.settings
        for value in state.values.values():
            dr.enable_grad(value)
        gaussians = state.gaussians(s)
        # Each view and the cube add their derivatives to these; then one pass takes them to the raw parameters.
        leaf = _leaf(gaussians)
        total = mi.Float(0)
        for view in views:
            total += self._view(state, leaf, self.targets[view], len(views))
        if s.lambda_tv > 0:
            total += self._total_variation(leaf, rng)
        _pass_on(leaf, gaussians)
        gradients = {name: dr.grad(value) for name, value in state.values.items()}
        if self.flat:
            gradients['centre'].z, gradients['scale'].z = 0, 0
            gradients['rotation'].x, gradients['rotation'].y = 0, 0
        state.adam(gradients, {name: s.rate(name, iteration) for name in gradients}, iteration + 1, s.epsilon)
        return total

    def render(self, state: DeviceState, view: View):
        """Normalised line integrals of a view, Float [height * width]."""
        f = project(*state.gaussians(self.settings), view, self.settings.extent)
        return splat(f, view.height, view.width, self.settings.extent) * view.lengths()

    def volume(self, state: DeviceState, geometry: Geometry | None = None) -> np.ndarray:
        """The cloud's density at the voxel centres, float32 [x, y, z]."""
        g = geometry or self.geometry
        grid = Grid(vector64(-g.half), vector64(2 * g.half / g.nVoxel), g.nVoxel)
        flat = voxelize(*state.gaussians(self.settings), grid, self.settings.extent)
        return np.ascontiguousarray(flat.numpy().reshape(g.nVoxel[::-1]).transpose(2, 1, 0))

    def _view(self, state, gaussians, target, batch):
        """Add one view's gradient to the parameters', and its part to the densification statistic."""
        s, view = self.settings, target.view
        footprints = project(*gaussians, view, s.extent)
        leaf = _leaf(footprints.values)  # their derivatives are wanted themselves, for the statistic
        image = splat(replace(footprints, values=leaf), view.height, view.width, s.extent) * view.lengths()
        loss = losses.combined(image, target.pixels, target.ssim, s.lambda_ssim)
        factor = losses.loss_scale(dr.detach(image)) if s.loss_scale != 'none' else mi.Float(1)
        weight = factor if s.loss_scale == 'dynamic' else mi.Float(1)
        dr.backward(loss * weight * (1 / batch))
        with dr.suspend_grad():
            gx, gy = dr.grad(leaf[-2]), dr.grad(leaf[-1])
            norm = dr.norm(mi.Vector2f(gx * (view.width / 2), gy * (view.height / 2))) * batch
            state.gradient += norm * factor if s.loss_scale == 'statistic' else norm
            state.seen += dr.select(footprints.row_end > footprints.row_begin, 1., 0.)
        _pass_on(leaf, footprints.values)
        return dr.detach(loss) * (1 / batch)

    def _total_variation(self, gaussians, rng):
        """Add the gradient of the total variation of a cube at a random place (R2-Gaussian)."""
        s = self.settings
        voxel = 2 * self.half / self.geometry.nVoxel
        shape = tuple(int(min(s.tv_size, n)) for n in self.geometry.nVoxel)
        corner = -self.half + rng.random(3) * (2 * self.half - shape * voxel)
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
        return dr.detach(loss)


def _leaf(values):
    """Copies that gather derivatives, cut off from what the values were made of."""
    copies = tuple(dr.detach(v) for v in values)
    dr.enable_grad(copies)
    return copies


def _pass_on(leaf, values):
    """Propagate the derivatives gathered in a leaf through the making of its values."""
    for value, copy in zip(values, leaf):
        if dr.grad_enabled(value):
            dr.set_grad(value, dr.grad(copy))
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
