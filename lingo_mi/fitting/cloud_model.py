"""The forward model of a fit: renders and voxelizes a state's cloud. It needs no scan."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.calibration.response.response import Response
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.expected_signal import ExpectedSignal
from lingo_mi.fitting.models import forward_model
from lingo_mi.fitting.scattered_light import light_at_pixels
from lingo_mi.fitting.settings import Settings
from lingo_mi.geometry.base import Geometry
from lingo_mi.projectors.objects import Ellipsoids
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View, vector64
from lingo_mi.projectors.voxelize import Grid, voxelize

# Voxels that are sampled at once: a larger volume is made in slabs, since sampling takes several times its memory.
AT_ONCE = 2**25


class CloudModel:
    """Renders and voxelizes the states of a fit.

    settings   of the fit
    geometry   of its scan, as given; defines the normalised frame and the default grid of `volume`
    unit       the fit's unit of density, 1/mm (`measured.density_unit`)
    effects    of the scan, if the fit models them (`measured.modelled_effects`); None: line integrals
    signal     `ExpectedSignal` of these effects; None without effects
    response   what else the detector makes of line integrals, as far as it was found with the cloud; None if that is not fitted
    """

    def __init__(self, settings: Settings, geometry: Geometry, unit: float, effects: Effects | None = None):
        """Raises InputError for effects that a fit cannot model."""
        self.settings, self.geometry, self.unit, self.effects = settings, geometry, unit, effects
        self.signal = None if effects is None else ExpectedSignal(effects, geometry, unit)
        self.response = Response.of(geometry, air=settings.calibration.fit_air, gain=settings.calibration.fit_gain)

    def expected(self, state: DeviceState, geometry: Geometry) -> np.ndarray:
        """What the scan's detector is expected to measure in the views of a geometry: `render` with the response found so far."""
        rendered = self.render(state, geometry)
        return rendered if self.response is None else self.response.applied(rendered, geometry)

    def render(
        self, state: DeviceState, geometry: Geometry, progress: Callable[[int, int], None] | None = None
    ) -> np.ndarray:
        """Noise-free projections in the views of a geometry, float32 [view, v, u].

        They are line integrals (density times mm), or -ln of the expected signal if the fit models effects. For alpha
        compositing they are the grey images.

        progress   called as progress(views done, all views)
        """
        g, (height, width) = self.geometry, geometry.nDetector
        # In the frame of the fit's own volume, whatever the voxels of this geometry.
        every = replace(geometry, nVoxel=g.nVoxel, dVoxel=g.dVoxel, offOrigin=g.offOrigin).normalised_rays()
        forward = forward_model(self.settings)
        gaussians, share = forward.gaussians(state.values), self.shares(state)

        scattered: list[Any] = [None] * len(geometry)
        found = self.scattered_light(state, geometry)
        if found is not None:
            scattered = [uploaded(image.ravel()) for image in light_at_pixels(found, geometry)]

        def along(rays):
            return forward.integrals(forward.footprints(gaussians, rays), rays, share)

        out = np.empty((len(geometry), height, width), np.float32)
        for i in range(len(geometry)):
            view = View.of(every, i, height, width)
            image = along(view)[0] if self.signal is None else self.signal.image(along, view, scattered[i])
            out[i] = image.numpy().reshape(height, width)
            if progress:
                progress(i + 1, len(geometry))
        out *= np.float32(self.unit / g.scale)
        return out

    def volume(self, state: DeviceState, geometry: Geometry | None = None) -> np.ndarray | None:
        """The cloud's density at the voxel centres of a geometry's grid, 1/mm, float32 [x, y, z] (default: of the scan's).

        None for alpha compositing, whose opacities are not densities.
        """
        if not self.settings.volumetric:
            return None
        own, gaussians = self.geometry, state.gaussians(self.settings)
        extent, wanted = self.settings.model.extent, geometry or own

        def values(part):
            if part is None:
                grid = Grid(vector64(-own.half), vector64(2 * own.half / own.nVoxel), own.nVoxel)
            else:
                low = np.array(part.offOrigin) - np.array(part.sVoxel) / 2 - own.offOrigin
                step = np.array(part.dVoxel)
                grid = Grid(vector64(low * own.scale), vector64(step * own.scale), part.nVoxel)
            return grid.volume(voxelize(*gaussians, grid=grid, extent=extent, deep=True))

        if math.prod(wanted.nVoxel) <= AT_ONCE:
            out = values(geometry)
        else:
            nx, ny, _ = wanted.nVoxel
            out = np.empty(wanted.nVoxel, np.float32)
            for begin, end in wanted.slabs(max(1, AT_ONCE // (4 * nx * ny))):
                out[:, :, begin:end] = values(wanted.slab(begin, end))
        out *= np.float32(self.unit)
        return out

    def shares(self, state: DeviceState) -> Any:
        """The second material's share in every Gaussian's density, Float [N]; None for one material."""
        volume = None if self.signal is None or self.signal.split is None else self.volume(state)
        if self.signal is None or volume is None:
            return None
        centres = np.stack([c.numpy() for c in state.values['centre']], 1)
        return self.signal.shares(volume, centres, self.geometry.half)

    def scattered_light(self, state: DeviceState, geometry: Geometry) -> np.ndarray | None:
        """What the cloud scatters into the views of a geometry, as `ScatteredLight.estimate` gives it; None where the fit models
        no scatter."""
        light = self.signal and self.signal.scattered
        cloud = self.cloud(state) if light else None
        return None if light is None or cloud is None else light.estimate(cloud, geometry)

    def cloud(self, state: DeviceState) -> Ellipsoids | None:
        """The Gaussians in the world frame, mm, densities in 1/mm; None for alpha compositing, which has no densities."""
        if not self.settings.volumetric:
            return None
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
