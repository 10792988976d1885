"""Starting densities that fit the projections: sampled from a volume, times one factor for all."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.interpolation import trilinear
from lingo_mi.fitting.start.start import Render
from lingo_mi.scan import Scan

VIEWS = 8  # evenly spaced views that the factor is fitted to: a few determine one number
# Least starting density, relative to the volume's largest: the volume's noise must not start Gaussians at zero.
FAINTEST = 0.02


def sampled_density(volume: np.ndarray, points: np.ndarray, half: ArrayLike) -> np.ndarray:
    """`trilinear` values of a volume of densities, raised to at least FAINTEST times its largest value."""
    return np.maximum(trilinear(volume, points, half), FAINTEST * volume.max())


def fitted_factor(scan: Scan, render: Render, points: np.ndarray, density: np.ndarray, spacing: np.ndarray) -> float:
    """The factor on the densities of a cloud that fits `VIEWS` evenly spaced views best, see `least_squares_factor`.

    Parameters
    ----------
    points, density, spacing : ndarray
        Arrays of the cloud, [N, 3], [N] and [N].
    """
    n = len(scan.geometry)
    views = np.unique(np.arange(min(n, VIEWS)) * n // min(n, VIEWS))
    rendered = render(points, density, spacing, views)
    trusted = ... if scan.valid is None else scan.valid[views]
    return least_squares_factor(scan.normalised[views][trusted], rendered[trusted])


def least_squares_factor(measured: np.ndarray, rendered: np.ndarray) -> float:
    """alpha = <I, Ihat> / <Ihat, Ihat>, which minimises |I - alpha Ihat|^2; 1 for an empty rendering.

    The sums are in float64. A negative factor (for mostly negative projections) is also replaced by 1.
    """
    rendered = np.asarray(rendered, np.float64).ravel()
    power = rendered @ rendered
    alpha = np.asarray(measured, np.float64).ravel() @ rendered / power if power > 0 else 1.0
    return float(alpha) if np.isfinite(alpha) and alpha > 0 else 1.0
