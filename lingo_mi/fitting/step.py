"""One step of the fit: render views of the cloud, compare them with the measured ones, and update the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.adam import adam_step
from lingo_mi.fitting.cloud_model import CloudModel
from lingo_mi.fitting.densify import densify, reset_opacity
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.measured import density_unit, modelled_effects, trusted, weights_of
from lingo_mi.fitting.models import forward_model
from lingo_mi.fitting.poses import Poses, gathered, place
from lingo_mi.fitting.scattered_light import RENEWED as LIGHT_RENEWED
from lingo_mi.fitting.scattered_light import light_at_pixels
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.state import State, start
from lingo_mi.fitting.total_variation import random_cube_variation
from lingo_mi.fitting.view_loss import Target, differentiate, differentiate_replayed
from lingo_mi.geometry.base import Geometry
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.projectors.backprop import leaves, pass_on
from lingo_mi.projectors.upload import uploaded
from lingo_mi.scan import Scan

RESPONSE_RENEWED = tuple(
    k / 10 for k in range(1, 10)
)  # shares of the iterations, before which the response is found anew
SHARES_RENEWED = 50  # steps between updates of the shares of two materials


class Stepper:
    """The optimisation of a cloud on one scan with one set of settings, step by step.

    settings    as used, with lengths in the normalised frame
    model       the fit's `CloudModel`, with the settings as given
    targets     the measured views, on the device; `coarse`: the same binned 2 x 2, for the first iterations
    poses       corrections of the views; None if poses are not fitted
    share       current share of the second of two materials in every Gaussian
    scattered   current result of `ScatteredLight.estimate`

    Where a response of the detector is fitted (`model.response`), `targets` hold what it leaves of the measured views: their line
    integrals. So a step is the same with and without.
    """

    def __init__(self, scan: Scan, settings: Settings):
        """Raises InputError for an empty scan, and for effects that a fit cannot reproduce."""
        self.geometry = scan.geometry
        scan = trusted(scan, settings)
        unit = density_unit(scan, settings)
        self.model = CloudModel(settings, scan.geometry, unit, modelled_effects(scan, settings))
        self.unit = unit
        self.measured = scan if self.model.response is not None else None
        self.settings = forward_model(settings).with_lengths(scan.geometry)
        self.forward = forward_model(self.settings)
        self.share: Any = None
        self.scattered: np.ndarray | None = None
        self.targets = _targets(scan, unit, settings)
        self.coarse_until = round(settings.coarse_share * settings.iterations)
        self.coarse = _targets(scan.binned(2), unit, settings) if self.coarse_until else []
        self.half = scan.geometry.half
        # A fan beam does not determine the direction across its plane: nothing moves or turns out of the plane.
        self.flat = scan.geometry.nVoxel[2] == 1
        smooth = settings.calibration.pose_motion == 'smooth'
        self.poses = Poses(len(scan), self.flat, smooth) if max(settings.adam.rate_pose) > 0 else None

    def start(self, initial: InitialCloud, rng: np.random.Generator) -> State:
        """The state at the start of a fit. `rng` is not used."""
        density = None if initial.density is None else initial.density / self.model.unit
        return start(initial.points.astype(np.float32), initial.spacing, density, self.settings)

    def renewed(self, state: DeviceState, iteration: int, rng: np.random.Generator) -> DeviceState | None:
        """The state after densification and reset of opacities, whichever is due at this iteration; None if neither is.

        Raises InputError if no Gaussian is left.
        """
        s = self.settings.densification
        densifying = iteration > s.densify_from and iteration % s.densify_every == 0
        resetting = s.reset_every and iteration > 0 and iteration % s.reset_every == 0
        if iteration >= s.densify_until or not (densifying or resetting):
            return None
        host = state.host()
        if densifying:
            largest = s.prune_size if 0 < s.reset_every < iteration else np.inf
            host = densify(host, self.settings, self.half, rng, self.flat, largest)
            if len(host) == 0:
                raise InputError('every Gaussian was pruned: the projections may be empty, or prune_density too high')
        self.share = None  # other Gaussians, or in another order
        return DeviceState(reset_opacity(host) if resetting else host)

    def step(self, state: DeviceState, views: Sequence[int], iteration: int, rng: np.random.Generator) -> Any:
        """Advance the state by one Adam step on the given views. Returns the loss, Float [1], not yet evaluated.

        `iteration` counts from 0. `rng` places the cube of the total variation.
        """
        s = self.settings
        if self.share is None or iteration % SHARES_RENEWED == 0:
            self.share = self.model.shares(state)
        lit = self.model.signal is not None and self.model.signal.scattered
        if lit and iteration in {round(x * s.iterations) for x in LIGHT_RENEWED}:
            self.renew_light(state)
        if self.measured is not None and iteration in {round(x * s.iterations) for x in RESPONSE_RENEWED}:
            self.renew_response(state)
        for value in state.values.values():
            dr.enable_grad(value)
        gaussians = self.forward.gaussians(state.values)
        # Views and cube accumulate derivatives in these. Then one pass propagates them to the raw parameters.
        leaf = leaves(gaussians)
        total, factors = mi.Float(0), []
        targets = self.coarse if iteration < self.coarse_until else self.targets
        for view in views:
            target = targets[view]
            if self.poses is not None:
                rays = self.poses.correct(target.rays, view)
                place(target.view, rays)
            loss, norm, visible, factor = self._view(leaf, target, len(views))
            total += loss
            factors.append(factor)
            state.gradient += norm
            state.visits += visible
            if self.poses is not None:
                self.poses.step(view, rays, gathered(target.view), s.rate('pose', iteration), s.adam)
        if s.loss.lambda_tv > 0:
            factor = sum(factors) if s.loss.loss_scale == 'dynamic' else None
            total += random_cube_variation(leaf, self.geometry, s, rng, factor)
        pass_on(gaussians, map(dr.grad, leaf))
        gradients = {name: dr.grad(value) for name, value in state.values.items()}
        if self.flat:
            gradients['centre'].z, gradients['scale'].z = 0, 0
            gradients['rotation'].x, gradients['rotation'].y = 0, 0
        self.forward.hold_back(gradients, iteration)
        adam_step(state, gradients, s, iteration)
        return total

    def corrected(self) -> Geometry:
        """The scan's geometry with corrected poses; the given geometry if poses are not fitted."""
        return self.geometry if self.poses is None else self.poses.corrected(self.geometry)

    def arrays(self) -> dict:
        """The arrays that steps keep besides the state, by name, for a checkpoint."""
        share = {} if self.share is None else dict(share=self.share.numpy())
        scattered = {} if self.scattered is None else dict(scattered=self.scattered)
        response = {} if self.model.response is None else self.model.response.arrays()
        return ({} if self.poses is None else self.poses.arrays()) | share | scattered | response

    def restore(self, arrays: dict) -> None:
        """Restore the output of `arrays`."""
        if self.poses is not None:
            self.poses.restore(arrays)
        if 'share' in arrays:
            self.share = uploaded(arrays['share'])
        if 'scattered' in arrays:
            self.scattered = arrays['scattered']
            self._light_targets()
        if self.model.response is not None:
            self.model.response.restore(arrays)
            self._line_integral_targets()

    def renew_response(self, state: DeviceState) -> None:
        """Find the response of the detector anew from what the cloud, as it is, would give."""
        if self.model.response is None or self.measured is None:
            return
        expected = self.model.render(state, self.corrected())
        self.model.response.fit(expected, self.measured.projections, self.measured.valid)
        self._line_integral_targets()

    def _line_integral_targets(self):
        """Give all views the line integrals that the response leaves of what was measured."""
        if self.model.response is None or self.measured is None:
            return
        undone = self.model.response.undone(self.measured.projections, self.geometry)
        scan = replace(self.measured, projections=undone)
        for targets, views in self._panels(scan):
            for target, new in zip(targets, _targets(views, self.unit, self.settings)):
                target.pixels, target.weights = new.pixels, new.weights

    def _panels(self, scan: Scan) -> list[tuple[list[Target], Scan]]:
        """The targets of all views with a scan of these pixels; and the coarse ones, if there are any, with one of theirs."""
        return [(self.targets, scan)] + ([(self.coarse, scan.binned(2))] if self.coarse else [])

    def renew_light(self, state: DeviceState) -> None:
        """Estimate again the light that the cloud scatters into the views."""
        self.scattered = self.model.scattered_light(state, self.corrected())
        self._light_targets()

    def _light_targets(self):
        """Give all views the scattered light that is expected in them."""
        if self.scattered is None:
            return
        views = Scan(self.geometry, light_at_pixels(self.scattered, self.geometry))
        for targets, scan in self._panels(views):
            for target, image in zip(targets, scan.projections):
                target.scattered = uploaded(image.ravel())

    def _view(self, leaf, target, batch):
        """`differentiate` a view; replayed if the fit is of plain line integrals with known poses."""
        if self.model.signal is None and self.poses is None and self.forward.replayable:
            return differentiate_replayed(leaf, target, self.settings, batch)
        return differentiate(leaf, target, self.settings, batch, self.model.signal, self.share)


def _targets(scan, unit, settings):
    weights = weights_of(scan, settings)
    return [Target.of(scan, i, unit, weights) for i in range(len(scan))]
