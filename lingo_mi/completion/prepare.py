"""Inputs of a voxel algorithm from a scan and a fit: views completed with it, or its volume as the start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.completion.views import as_corrected, complete_views, fitted_views, without_effects
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.fast import Fast
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.reconstruction import FDK, Algorithm, Refined
from lingo_mi.reconstruction.preconditions import require_rays
from lingo_mi.scan import Scan


def fit_cloud(scan: Scan, progress: Callable[[int, int], None]) -> Callable[[Grid], np.ndarray]:
    """Fit a cloud to line integrals by `Fast`, and return the function that samples its volume; the `fit` of `Best`.

    Parameters
    ----------
    progress : callable
        Called as progress(iterations done, iterations).
    """
    method = Fast()
    return run(replace(scan, effects=None), method, progress=lambda done, **_: progress(done, method.iterations)).volume


def prepare_completed(scan: Scan, fit: Fit, views: int, algorithm: Algorithm) -> tuple[Scan, dict[str, Any]]:
    """The views that a fit has seen, and views between them, rendered from it: `views` in all.

    `Refined` gets the measured views and, in addition, the completed ones and the fit's densities. Any other algorithm gets the
    completed views.

    Parameters
    ----------
    scan : Scan
        Holds the views that the fit has seen.

    Raises
    ------
    InputError
        As `fitted_views`, `require_rays` and `complete_views` do, and for FDK if the fit has corrected the poses. Whether there
        is memory for the algorithm is not checked.

    Examples
    --------
    >>> completed, inputs = prepare_completed(scan, fit, 100, algorithm)
    >>> found = run_algorithm(completed, algorithm, **inputs)
    """
    if isinstance(algorithm, Refined):
        require_volume(fit)
    measured = fitted_views(scan, fit.nominal_geometry)
    on_circle = [isinstance(g, CircularGeometry) for g in (measured.geometry, fit.geometry)]
    if isinstance(algorithm, FDK) and on_circle == [True, False]:
        raise InputError(
            'filtered backprojection needs a source on a circle, and the fit has corrected the poses: '
            'take another algorithm'
        )
    require_rays(measured.geometry)
    whole = complete_views(measured, fit, views)
    if isinstance(algorithm, Refined):
        return whole.subset(np.arange(len(measured))), dict(completed=whole, sample=fit.volume)
    return whole, {}


def prepare_start(scan: Scan, fit: Fit, algorithm: Algorithm) -> tuple[Scan, dict[str, Any]]:
    """The views that a fit has seen, with its volume as the start.

    `Refined` gets a function that samples the fit's densities; its completed_niter must be 0.

    Parameters
    ----------
    scan : Scan
        Holds the views that the fit has seen.

    Raises
    ------
    InputError
        As `fitted_views` does, and for a fit without a volume.

    Examples
    --------
    >>> views, inputs = prepare_start(scan, fit, algorithm)
    >>> found = run_algorithm(views, algorithm, **inputs)
    """
    require_volume(fit)
    views = without_effects(as_corrected(fitted_views(scan, fit.nominal_geometry), fit), fit)
    if isinstance(algorithm, Refined):
        return views, dict(sample=fit.volume)
    return views, dict(start=fit.volume(views.geometry.grid))


def require_volume(fit: Fit) -> None:
    """Raises InputError for a fit without a volume."""
    if not fit.method.makes_volume:
        raise InputError(
            f'{fit.method.name} fits opacities, not densities, and has no volume: start from a fit by fast, lingo, r2 or naf'
        )
