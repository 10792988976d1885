"""Initial densities (paper, section III-B): the mean pixel, and its conversion to a density. NumPy and SciPy.

The paper sets the path length to 1, so that a pixel p = integral of sigma "is" sigma. A point's pixel is then a
density up to a factor, which depends on the object's size and on the overlap of the Gaussians. The factor is
chosen here:

    'paper'   0.15, the constant of the R2-Gaussian backbone (the paper names none of its own)
    'raw'     1
    'lsq'     the factor that fits the projections best, see `least_squares_factor`
    'fdk'     an FDK volume at the point instead of the mean pixel, times the factor of 'lsq' (own: sharper)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lingo_mi.geometry.camera import camera_matrices
from lingo_mi.geometry.rays import Rays
from lingo_mi.lingo.voxel_filter import pixels
from lingo_mi.scan import Scan

FACTORS = {'paper': 0.15, 'raw': 1.0}
MODES = (*FACTORS, 'lsq', 'fdk')
LSQ_VIEWS = 8  # evenly spaced views for the factor of 'lsq' and 'fdk' (own choice: a few determine one number)
# Least initial density, relative to the FDK volume's largest: the volume's noise must not start Gaussians at zero.
FAINTEST = 0.02


def mean_pixel(rays: Rays, projections: np.ndarray, points: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """C = 1/n sum over views of I_o[P^I_o], [N], in units of the projections.

    rays         n views in the normalised frame
    projections  [n, v, u]
    points       [N, 3]
    valid        bool [n, v, u], None: all pixels are valid

    The mean is over the views in which the point projects to a valid pixel (in the paper's intersection, all
    views). A point outside all views has the mean 0.
    """
    points = np.ascontiguousarray(np.asarray(points, float).T)
    total, seen = np.zeros(points.shape[1]), np.zeros(points.shape[1])
    for view, (matrix, image) in enumerate(zip(camera_matrices(rays), projections)):
        index, inside = pixels(matrix, points, image.shape)
        if valid is not None:
            inside &= valid[view].reshape(-1)[index]
        total += np.where(inside, image.reshape(-1)[index], 0)
        seen += inside
    return total / np.maximum(seen, 1)


def trilinear(volume: np.ndarray, points: np.ndarray, half: ArrayLike) -> np.ndarray:
    """Trilinear interpolation of a volume at points, [N]; constant beyond the outermost voxel centres.

    volume  [x, y, z]
    points  [N, 3] and half, [3], half the volume's sides: both in the normalised frame
    """
    place = (np.asarray(points, float) / half + 1) / 2 * volume.shape - 0.5
    return ndimage.map_coordinates(volume, place.T, order=1, mode='nearest')


def sampled(volume: np.ndarray, points: np.ndarray, half: ArrayLike) -> np.ndarray:
    """`trilinear` values of a volume of densities, raised to at least FAINTEST times its largest value."""
    return np.maximum(trilinear(volume, points, half), FAINTEST * volume.max())


def fitted_factor(
    scan: Scan, render: Callable[..., np.ndarray], points: np.ndarray, density: np.ndarray, spacing: np.ndarray
) -> float:
    """The factor on the densities of a cloud that fits `LSQ_VIEWS` evenly spaced views best, see `least_squares_factor`.

    render                     as of `lingo.initialise`
    points, density, spacing   of the cloud, [N, 3], [N] and [N]
    """
    n = len(scan.geometry)
    views = np.unique(np.arange(min(n, LSQ_VIEWS)) * n // min(n, LSQ_VIEWS))
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
