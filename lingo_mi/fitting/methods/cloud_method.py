"""Base of all methods with Gaussians: a start, a loss, densification, bounds."""

from __future__ import annotations

import time
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from typing_extensions import Self

from lingo_mi.common.errors import InputError
from lingo_mi.common.memory import room
from lingo_mi.common.runtime import drjit_lock
from lingo_mi.fitting import state as states
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.measured import density_unit, trusted
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.models.forward import ForwardModel
from lingo_mi.fitting.options.bounds import ScaleBounds
from lingo_mi.fitting.options.densification import Clone, Densify
from lingo_mi.fitting.options.loss import ImageLoss
from lingo_mi.fitting.start.fdk import FDKStart
from lingo_mi.fitting.start.start import Start, StartingCloud
from lingo_mi.fitting.state import State
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors import cutoff
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.scan import Scan

BYTES = 500  # least memory of a fit for each Gaussian: 14 parameters, their moments and derivatives, and copies


@dataclass(frozen=True)
class CloudMethod(Method):
    """A method whose parameters are Gaussians. In the normalised frame the volume's longest side is 2.

    Parameters
    ----------
    iterations, batch, view_order, checkpoint_seconds, stopping, rates
        See `Method`.
    start : Start
        Start of the Gaussians.
    loss : ImageLoss
        Comparison with the measured views.
    densify : Densify
        When Gaussians are added and removed, and how.
    bounds : ScaleBounds
        Bounds of the standard deviations.
    normalise : bool
        Whether to fit in a unit of density that makes the largest line integral 1. SSIM's constants and the bounds then mean the
        same for any object. R2-Gaussian expects volumes in [0, 1] instead.
    extent : float
        Cut-off in standard deviations (R2-Gaussian: 3, rounded up to whole tiles of 16 x 16 pixels).
    """

    RANGES: ClassVar = Method.RANGES | dict(extent=(1, 20))

    start: Start = FDKStart()
    loss: ImageLoss = ImageLoss()
    densify: Densify = Clone()
    bounds: ScaleBounds = ScaleBounds()
    normalise: bool = False
    extent: float = cutoff.FIT

    @property
    @abstractmethod
    def forward(self) -> ForwardModel:
        """The model that turns Gaussians into the image of a view."""

    def with_lengths(self, geometry: Geometry) -> Self:
        """The method with lengths in the normalised frame, if some are in another unit."""
        return self

    def shapes(self, count: int) -> dict[str, tuple[int, int]]:
        return {name: (count, size) for name, size in self.forward.parameters.items()}

    def bounded(self, scan: Scan) -> Self:
        """The method with the limits that a scan sets.

        `values_per_gaussian` limits the number of Gaussians. The largest scale is lowered so that no Gaussian in the volume can
        reach the source: in a cone beam such a Gaussian has no footprint (see `projectors.footprint`).

        Raises
        ------
        InputError
            As `Method.bounded`, and if the source is inside the volume.
        """
        method, g = super().bounded(scan), scan.geometry
        start, densify = method.start, method.densify
        if densify.values_per_gaussian > 0:
            valid = trusted(scan, self.effects).valid
            measured = scan.projections.size if valid is None else int(valid.sum())
            most = min(max(int(measured / densify.values_per_gaussian), 1), densify.max_gaussians)
            start, densify = start.limited(most), replace(densify, max_gaussians=most)
        count = start.count(g)
        if count * BYTES > (has := room()):
            raise InputError(
                f'{count} Gaussians need at least {count * BYTES / 2**30:,.1f} GiB of memory, but this process may take '
                f'{has / 2**30:,.1f} GiB: lower n_points'
            )
        method = replace(method, start=start, densify=densify)
        if g.mode == 'parallel':
            return method
        rays = g.normalised_rays(curved=True)
        clear = np.linalg.norm(rays.source, axis=1).min() - np.linalg.norm(g.grid.half)
        largest = 0.9 * clear / self.extent
        if largest <= self.bounds.scale_min:
            raise InputError('the source lies within the volume or close to it: check DSO, nVoxel and dVoxel')
        return replace(method, bounds=replace(self.bounds, scale_max=min(self.bounds.scale_max, largest)))

    @drjit_lock()
    def starting_cloud(self, scan: Scan, seed: int = 0) -> StartingCloud:
        """The cloud that a fit of the scan starts from. `info['seconds']` is the whole time that it took.

        Raises
        ------
        InputError
            If the scan gives no cloud.
        """
        begun = time.perf_counter()
        method = self.bounded(scan)
        scan = line_integrals(scan) if self.effects == 'model' else replace(scan, effects=None)
        scan = scan.to_flat()  # a start need not be exact
        unit, geometry = density_unit(scan, self.normalise), scan.geometry

        def render(points, density, spacing, views):
            forward = method.forward
            state = DeviceState(states.start(points, spacing, density / unit, forward))
            return method.model(geometry, unit).render(state, geometry.subset(views)) * geometry.grid.scale

        cloud = method.start.cloud(scan, np.random.default_rng(seed), render, unit)
        return replace(cloud, info=cloud.info | dict(seconds=time.perf_counter() - begun))

    def starting_state(self, cloud: StartingCloud, unit: float) -> State:
        """The state of isotropic, unrotated Gaussians with zero moments."""
        density = None if cloud.density is None else cloud.density / unit
        return states.start(cloud.points.astype(np.float32), cloud.spacing, density, self.forward)
