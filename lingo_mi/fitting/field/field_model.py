"""The forward model of a fit of a neural field: renders a state's field and samples it on voxels. It needs no scan."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field.network import Network
from lingo_mi.fitting.field.options import Field
from lingo_mi.fitting.field.rays import FieldBox, integrals, pixels_of
from lingo_mi.fitting.models.model import Model
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.projectors.grid import view_table
from lingo_mi.projectors.upload import uploaded

POINTS = 2**18  # points of the field that are evaluated at once


class FieldModel(Model):
    """Renders and samples a neural field. No density exceeds `unit` (see `densities.largest_density`).

    Parameters
    ----------
    options : Field
        Options of the field.
    """

    def __init__(self, options: Field, geometry: Geometry, unit: float):
        super().__init__(geometry, unit)
        self.options, self.cube = options, FieldBox(geometry, options.field_cube)

    @cached_property
    def network(self) -> Network:
        return Network(self.options)

    def integrals(self, values: dict, row: Any, x: Any, y: Any, within: Any) -> Any:
        """Line integrals along rays of a view, as `rays.integrals` gives them, in the fit's unit times normalised length."""
        result = integrals(
            lambda points: self.network.density(values, points),
            self.cube,
            row,
            x,
            y,
            self.options.field_samples,
            within,
        )
        return result * dr.opaque(mi.Float, self.geometry.grid.scale)

    def render(
        self, state: DeviceState, geometry: Geometry, progress: Callable[[int, int], None] | None = None
    ) -> np.ndarray:
        """Projections in the views of a geometry, float32 [view, v, u], density times mm: the midpoint rule on every ray.

        Parameters
        ----------
        progress : callable or None
            Called as progress(views done, all views).
        """
        g, (height, width) = self.geometry, geometry.nDetector
        every = geometry.on(g.grid)
        at_once = max(POINTS // self.options.field_samples, 1)
        out = np.empty((len(geometry), height * width), np.float32)
        for i, row in enumerate(view_table(every)):
            on_device = uploaded(row)
            for first in range(0, height * width, at_once):
                pixels = np.arange(first, min(first + at_once, height * width))
                x, y = map(uploaded, pixels_of(pixels, width))
                out[i, pixels] = self.integrals(state.values, on_device, x, y, 0.5).numpy()
            if progress:
                progress(i + 1, len(geometry))
        out *= np.float32(self.unit / g.grid.scale)
        return out.reshape(len(geometry), height, width)

    def volume(self, state: DeviceState, grid: Grid | None = None) -> np.ndarray:
        """The field at the voxel centres of a grid (default: the scan's), 1/mm, float32 [x, y, z].

        It is 0 outside the scan's volume, where no ray has sampled it.
        """
        scan_grid = self.geometry.grid
        grid = grid or scan_grid
        shift = np.array(grid.centre) - np.array(scan_grid.centre)
        axes = [
            ((np.arange(n) + 0.5 - n / 2) * d + s) / scan_d + (scan_n - 1) / 2
            for n, d, s, scan_n, scan_d in zip(grid.shape, grid.spacing, shift, scan_grid.shape, scan_grid.spacing)
        ]
        inside = [(a > -0.5 - 1e-6) & (a < n - 0.5 + 1e-6) for a, n in zip(axes, scan_grid.shape)]
        out = np.zeros(int(np.prod(grid.shape)), np.float32)
        chosen = np.flatnonzero(inside[0][:, None, None] & inside[1][:, None] & inside[2])
        for first in range(0, len(chosen), POINTS):
            part = chosen[first : first + POINTS]
            where = np.unravel_index(part, grid.shape)
            points = self.cube.of_grid([uploaded(a[i]) for a, i in zip(axes, where)])
            out[part] = self.network.density(state.values, [dr.clip(p, 0, 1) for p in points]).numpy()
        return out.reshape(grid.shape) * np.float32(self.unit)
