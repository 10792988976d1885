"""The default scan of a phantom: X3D's circular cone beam, simulated without noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.geometry import CircularGeometry, Geometry
from lingo_mi.geometry.trajectories import circular
from lingo_mi.phantoms import Phantom
from lingo_mi.scan import Dataset, Scan

PIXELS = 512  # along the panel's sides


def default_geometry(phantom: Phantom, angles: ArrayLike, pixels: int = PIXELS) -> Geometry:
    """X3D's scanner about a phantom.

    DSD 1500 and DSO 1000 mm. The panel of `pixels` x `pixels` is twice as wide as the phantom's longest side (512
    pixels of 1 mm for a cube of 256 mm).
    """
    pixel = 2 * max(n * d for n, d in zip(phantom.data.shape, phantom.spacing)) / pixels
    return CircularGeometry(
        DSO=1000.0,
        DSD=1500.0,
        nDetector=(pixels, pixels),
        dDetector=(pixel, pixel),
        angles=np.asarray(angles, float),
        grid=phantom.grid,
    )


def project_phantom(
    phantom: Phantom, geometry: Geometry, progress: Callable[[int, int], None] | None = None
) -> np.ndarray:
    """Noise-free line integrals, float32 [view, v, u], density times mm.

    Exact projections of the object if the phantom has them and the grid is its own, of its size about the origin; else exact
    projections of its voxels on the geometry's grid, trilinear, which need an active Mitsuba variant.
    progress: called as progress(views done, views) after every view.
    """
    same_grid = np.allclose(geometry.grid.spacing, phantom.spacing, rtol=1e-6) and not any(geometry.grid.centre)
    if phantom.analytic is None or not same_grid:
        from lingo_mi.projectors import grid

        return grid.project_volume(phantom.data, geometry, progress)
    out = np.empty((len(geometry), *geometry.nDetector), np.float32)
    for i in range(len(geometry)):
        out[i] = phantom.analytic.project(geometry.subset([i]))[0]
        if progress:
            progress(i + 1, len(geometry))
    return out


def scan(
    phantom: Phantom,
    views: int = 50,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    pixels: int = PIXELS,
) -> Dataset:
    """The default scan: `views` views to fit, evenly spaced over [0, 180) degrees, and as many held-out views at
    random angles in this range.

    seed: of the held-out angles. pixels: of the panel (see `default_geometry`).

    Raises
    ------
    InputError
        Unless views is at least 1.
    """
    if views < 1:
        raise InputError(f'a scan needs at least one view, not {views}')
    ensure_variant()
    angles = np.concatenate([circular(views, 180.0), np.sort(np.random.default_rng(seed).uniform(0, np.pi, views))])
    geometry = default_geometry(phantom, angles, pixels)
    both = Scan(geometry, project_phantom(phantom, geometry, progress))
    return Dataset(both.subset(slice(0, views)), both.subset(slice(views, None)), phantom.data)
