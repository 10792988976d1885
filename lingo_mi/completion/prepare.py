"""Inputs of a voxel algorithm from a scan and a fitted cloud: views completed with it, or its volume as the start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.completion.clouds import FittedCloud
from lingo_mi.completion.views import as_corrected, complete, fitted_views, without_effects
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.loop import run as fit
from lingo_mi.fitting.recipes import FAST
from lingo_mi.geometry.base import CircularGeometry, Geometry
from lingo_mi.reconstruction import FDK, Algorithm, Best, Refined
from lingo_mi.reconstruction.preconditions import require_rays
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.truth import voxelize_cloud


def sampled(cloud: FittedCloud | Fitted) -> Callable[[Geometry], np.ndarray]:
    """A function of a geometry that returns the cloud's densities per mm at its voxel centres, float32 [x, y, z].

    Of a neural field it returns the field's. Raises InputError for a cloud of alpha compositing, which has no densities.
    """
    if isinstance(cloud, Fitted) and cloud.settings.volumetric:
        return _of_field(cloud)
    if isinstance(cloud, Fitted):
        raise InputError(
            'this recipe fits opacities, not densities, and has no volume: use a cloud of fast, lingo or r2'
        )

    def sample(geometry: Geometry) -> np.ndarray:
        return voxelize_cloud(cloud.gaussians, geometry, cloud.extent)

    return sample


def _of_field(field: Fitted) -> Callable[[Geometry], np.ndarray]:
    def sample(geometry: Geometry) -> np.ndarray:
        volume = field.volume(geometry)
        assert volume is not None  # of a field
        return volume

    return sample


def fit_cloud(scan: Scan, progress: Callable[[int, int], None]) -> Callable[[Geometry], np.ndarray]:
    """Fit a cloud to line integrals by the recipe `fast`, and return the function that samples it; the `fit` of `Best`.

    progress   called as progress(iterations done, iterations)
    """
    scan = replace(scan, effects=None)
    iterations = FAST.iterations
    return sampled(fit(scan, FAST, initial_cloud(scan, FAST), progress=lambda done, **_: progress(done, iterations)))


def prepare_completed(
    dataset: Dataset, cloud: FittedCloud | Fitted, views: int, algorithm: Algorithm
) -> tuple[Scan, dict[str, Any]]:
    """The views that a cloud was fitted to, and views between them, rendered from it: `views` in all.

        scan, inputs = prepare_completed(dataset, cloud, 100, algorithm)
        found = reconstruct(scan, algorithm, **inputs)

    dataset   holds the views that the cloud was fitted to

    `Refined` gets the measured views and, in addition, the completed ones and the cloud's densities. Any other algorithm gets
    the completed views. Raises InputError as `fitted_views`, `require_rays` and `complete` do, and for FDK if the fit has
    corrected the poses. Whether there is memory for the algorithm is not checked.
    """
    _refuse_best(algorithm)
    measured = fitted_views(dataset, cloud.geometry)
    on_circle = [isinstance(g, CircularGeometry) for g in (measured.geometry, cloud.corrected)]
    if isinstance(algorithm, FDK) and on_circle == [True, False]:
        raise InputError(
            'filtered backprojection needs a source on a circle, and the fit has corrected the poses: '
            'take another algorithm'
        )
    require_rays(measured.geometry)
    whole = complete(measured, cloud, views)
    if isinstance(algorithm, Refined):
        return whole.subset(np.arange(len(measured))), dict(completed=whole, sample=sampled(cloud))
    return whole, {}


def prepare_start(dataset: Dataset, cloud: FittedCloud | Fitted, algorithm: Algorithm) -> tuple[Scan, dict[str, Any]]:
    """The views that a cloud was fitted to, with the cloud's volume as the start.

        scan, inputs = prepare_start(dataset, cloud, algorithm)
        found = reconstruct(scan, algorithm, **inputs)

    dataset   holds the views that the cloud was fitted to

    `Refined` gets a function that samples the cloud's densities; its completed_niter must be 0. Raises InputError as
    `fitted_views` and `sampled` do.
    """
    _refuse_best(algorithm)
    scan = without_effects(as_corrected(fitted_views(dataset, cloud.geometry), cloud), cloud)
    sample = sampled(cloud)
    return scan, dict(sample=sample) if isinstance(algorithm, Refined) else dict(start=sample(scan.geometry))


def _refuse_best(algorithm: Algorithm) -> None:
    if isinstance(algorithm, Best):
        raise InputError('best chooses by measured views, which a fitted cloud has seen already: leave the cloud out')
