"""One step of a fit of Gaussians: render views, compare them with the measured ones, update the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.adam import adam_step
from lingo_mi.fitting.corrections.correction import Correction
from lingo_mi.fitting.densify import densify, reset_opacity
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.measured import trusted
from lingo_mi.fitting.method import Method, Stepper
from lingo_mi.fitting.methods.cloud_method import CloudMethod
from lingo_mi.fitting.models.cloud import CloudModel
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.fitting.state import State
from lingo_mi.fitting.total_variation import random_cube_variation
from lingo_mi.fitting.view_cluster import ViewsOfWorker, ViewsOnWorkers
from lingo_mi.fitting.view_loss import MeasuredView, differentiate, differentiate_replayed, targets_of
from lingo_mi.fitting.view_sums import ViewsHere, ViewSums
from lingo_mi.geometry.base import Geometry
from lingo_mi.jobs.actors import Actors
from lingo_mi.jobs.cluster import Cluster
from lingo_mi.projectors.backprop import leaves, pass_on
from lingo_mi.scan import Scan


class GaussianStepper(Stepper):
    """The optimisation of Gaussians on one scan, step by step.

    Attributes
    ----------
    method : CloudMethod
        As used, with lengths in the normalised frame.
    model : CloudModel
        Model of the fit.
    targets : list of MeasuredView
        The measured views on the device.
    corrections : sequence of Correction
        Corrections that are fitted with the cloud.
    share : Float or None
        Share of the second of two materials in every Gaussian.
    views : ViewSums
        What renders and differentiates the views.
    """

    method: CloudMethod
    model: CloudModel

    def __init__(self, method: CloudMethod, scan: Scan, model: CloudModel, corrections: Sequence[Correction] = ()):
        self.scan, self.geometry, self.model = scan, scan.geometry, model
        self.method = method.with_lengths(scan.geometry)
        self.forward, self.corrections, self.share = self.method.forward, corrections, None
        self.targets = targets_of(trusted(scan, method.effects), model.unit, method.loss.weights)
        self.views: ViewSums = ViewsHere()
        # A fan beam does not determine the direction across its plane: nothing moves or turns out of the plane.
        self.flat = scan.geometry.grid.shape[2] == 1
        moving = any(correction.moves_views for correction in corrections)
        self.replays = self.forward.replayable and model.signal is None and not moving

    def begin(self, seed: int) -> tuple[State, np.ndarray, dict]:
        cloud = self.method.starting_cloud(self.scan, seed)
        return self.method.starting_state(cloud, self.model.unit), cloud.points.astype(np.float32), cloud.info

    def step(self, state: DeviceState, views: Sequence[int], iteration: int, rng: np.random.Generator) -> Any:
        """See `Stepper.step`; `rng` places the cube of the total variation."""
        for correction in self.corrections:
            correction.before_step(self, state, iteration)
        for value in state.values.values():
            dr.enable_grad(value)
        gaussians = self.forward.gaussians(state.values)
        # Views and cube accumulate derivatives in these. Then one pass propagates them to the raw parameters.
        leaf = leaves(gaussians)
        total, factor = self.views.add(self, leaf, state, views, len(views), iteration)
        loss = self.method.loss
        if isinstance(loss, Loss) and loss.lambda_tv > 0:
            total += random_cube_variation(leaf, self.geometry, loss, self.method.extent, rng, factor)
        pass_on(gaussians, map(dr.grad, leaf))
        self._update(state, iteration)
        return total

    def compare(self, leaf: tuple, target: MeasuredView, batch: int) -> Sequence:
        """`differentiate` a view; replayed if the fit is of plain line integrals with known poses."""
        if self.replays:
            return differentiate_replayed(leaf, target, self.method.loss, self.forward, batch)
        return differentiate(leaf, target, self.method.loss, self.forward, batch, self.model.signal, self.share)

    def divide(self, cluster: Cluster, method: Method) -> None:
        """See `Stepper.divide`; this process then keeps no views on its device."""
        if self.corrections:
            raise InputError(
                'cluster= divides the views of a step among workers, which cannot fit poses, air levels, gains, scattered light '
                'or two materials as well: leave out cluster, or these options'
            )
        if any(address.startswith('inproc:') for address in cluster.client.nthreads()):
            raise InputError(
                'the workers of the cluster are threads of this process, which share one Dr.Jit: start processes'
            )
        workers = Actors(cluster, ViewsOfWorker(method, self.scan))
        self.views, self.targets = ViewsOnWorkers(workers, tuple(self.forward.parameters)), []

    def densified(self, state: DeviceState, iteration: int, rng: np.random.Generator) -> DeviceState | None:
        """The state after densification and reset of opacities, whichever is due at this iteration; None if neither is.

        Raises
        ------
        InputError
            If no Gaussian is left.
        """
        control = self.method.densify
        densifying = iteration > control.densify_from and iteration % control.densify_every == 0
        resetting = control.reset_every and iteration > 0 and iteration % control.reset_every == 0
        if iteration >= control.densify_until or not (densifying or resetting):
            return None
        host = state.host()
        if densifying:
            host = densify(
                host, control, self.forward, self.geometry.grid.half, rng, self.flat, control.largest(iteration)
            )
            if len(host) == 0:
                raise InputError('every Gaussian was pruned: the projections may be empty, or prune_density too high')
        for correction in self.corrections:
            correction.after_densification(self)
        return DeviceState(reset_opacity(host) if resetting else host)

    def corrected(self) -> Geometry:
        geometry = self.geometry
        for correction in self.corrections:
            geometry = correction.corrected(geometry)
        return geometry

    def between(self, geometry: Geometry) -> Geometry:
        for correction in self.corrections:
            geometry = correction.between(self.geometry, geometry)
        return geometry

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: array for correction in self.corrections for name, array in correction.arrays().items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        for correction in self.corrections:
            correction.restore(self, arrays)

    def _update(self, state: DeviceState, iteration: int) -> None:
        """Move the parameters by Adam."""
        gradients = {name: dr.grad(value) for name, value in state.values.items()}
        if self.flat:
            gradients['centre'].z, gradients['scale'].z = 0, 0
            gradients['rotation'].x, gradients['rotation'].y = 0, 0
        self.forward.hold_back(gradients, iteration)
        adam_step(state, gradients, self.method, iteration)
