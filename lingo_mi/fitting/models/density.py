"""The model of Gaussians with densities: their volume, and what a detector is expected to see of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.calibration.response.response import Response
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.expected_signal import ExpectedSignal
from lingo_mi.fitting.models.cloud import CloudModel
from lingo_mi.fitting.models.forward import ForwardModel
from lingo_mi.fitting.models.scattered_light import light_at_pixels
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors.objects import Ellipsoids
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import vector64
from lingo_mi.projectors.voxelize import Lattice, voxelize

# Voxels that are sampled at once: a larger volume is made in slabs, since sampling takes several times its memory.
AT_ONCE = 2**25


class DensityModel(CloudModel):
    """Renders and voxelizes Gaussians with densities.

    Attributes
    ----------
    signal
        `ExpectedSignal` of the effects; None without effects.
    extent
        Cut-off in standard deviations.
    """

    def __init__(
        self,
        forward: ForwardModel,
        geometry: Geometry,
        unit: float,
        effects: Effects | None,
        response: Response | None,
        extent: float,
    ):
        """Raises InputError for effects that a fit cannot model."""
        super().__init__(forward, geometry, unit)
        self.effects, self.response, self.extent = effects, response, extent
        self.signal = None if effects is None else ExpectedSignal(effects, geometry, unit)

    @property
    def amount_unit(self) -> float:
        return self.unit

    def render(
        self, state: DeviceState, geometry: Geometry, progress: Callable[[int, int], None] | None = None
    ) -> np.ndarray:
        """Render as in `Model`: line integrals, or -ln of the expected signal if the fit models effects."""
        signal, share = self.signal, self.shares(state)
        if signal is None:
            return super().render(state, geometry, progress)
        scattered: list[Any] = [None] * len(geometry)
        light = self.scattered_light(state, geometry)
        if light is not None:
            scattered = [uploaded(image.ravel()) for image in light_at_pixels(light, geometry)]
        return self._images(
            state, geometry, lambda along, view, i: signal.image(along, view, scattered[i]), share, progress
        )

    def line_integrals(self, state: DeviceState, geometry: Geometry) -> np.ndarray:
        return super().render(state, geometry)

    def volume(self, state: DeviceState, grid: Grid | None = None) -> np.ndarray:
        scan_grid, gaussians, wanted = (
            self.geometry.grid,
            self.forward.gaussians(state.values),
            grid or self.geometry.grid,
        )

        def values(part):
            if part is None:
                cells = Lattice(
                    vector64(-scan_grid.half), vector64(2 * scan_grid.half / scan_grid.shape), scan_grid.shape
                )
            else:
                low, step = part.low - scan_grid.centre, np.array(part.spacing)
                cells = Lattice(vector64(low * scan_grid.scale), vector64(step * scan_grid.scale), part.shape)
            return cells.volume(voxelize(*gaussians, grid=cells, extent=self.extent, deep=True))

        if math.prod(wanted.shape) <= AT_ONCE:
            out = values(grid)
        else:
            nx, ny, _ = wanted.shape
            out = np.empty(wanted.shape, np.float32)
            for begin, end in wanted.slabs(max(1, AT_ONCE // (4 * nx * ny))):
                out[:, :, begin:end] = values(wanted.slab(begin, end))
        out *= np.float32(self.unit)
        return out

    def shares(self, state: DeviceState) -> Any:
        if self.signal is None or self.signal.split is None:
            return None
        centres = np.stack([c.numpy() for c in state.values['centre']], 1)
        return self.signal.shares(self.volume(state), centres, self.geometry.grid.half)

    def scattered_light(self, state: DeviceState, geometry: Geometry) -> np.ndarray | None:
        """Return the light that the cloud scatters into the views of a geometry, by `ScatteredLight.estimate`; None if the fit
        does not model scatter."""
        light = self.signal and self.signal.scattered
        return light.estimate(self.cloud(state), geometry) if light else None

    def cloud(self, state: DeviceState) -> Ellipsoids:
        centre, scale, rotation, density = (dr.detach(x) for x in self.forward.gaussians(state.values))
        size, middle = dr.opaque(mi.Float, self.geometry.grid.scale), dr.opaque(mi.Point3f, self.geometry.grid.centre)
        return Ellipsoids.of(
            centre / size + middle,
            scale / size,
            rotation,
            density * dr.opaque(mi.Float, self.unit),
            self.shares(state),
            'cloud',
        )
