"""The initial cloud of R2-Gaussian from an FDK volume (the baseline of every comparison). NumPy and SciPy."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.lingo.voxel_filter import voxel_centres
from lingo_mi.metrics.ipsd import neighbour_distance


def r2_initialise(
    volume: ArrayLike,
    half: ArrayLike,
    rng: np.random.Generator | None = None,
    n_points: int = 50_000,
    threshold: float = 0.05,
    rescale: float = 0.15,
) -> InitialCloud:
    """Random voxels of an FDK volume (R2-Gaussian, section 4.1 and its released settings).

    volume     [x, y, z], densities (the same numbers in the normalised frame)
    half       half the volume's sides in the normalised frame, [3] (`Geometry.half`)
    rng        numpy Generator (default: seed 0)
    n_points   voxels drawn without replacement; all voxels above the threshold if they are fewer
    threshold  only voxels above it are drawn
    rescale    density of a Gaussian divided by that of its voxel

    Points lie at voxel centres.

    Raises InputError if no voxel is above the threshold.
    """
    begun = time.perf_counter()
    rng = np.random.default_rng(0) if rng is None else rng
    volume = np.asarray(volume)
    cells = np.flatnonzero(volume > threshold)
    if len(cells) == 0:
        raise InputError(
            f'no voxel of the FDK volume is above {threshold:g} (the largest is {volume.max():g}): set a lower '
            'fdk_threshold, or normalise=true'
        )
    chosen = rng.permutation(cells)[:n_points]
    points = voxel_centres(volume.shape, half, chosen)
    size = 2 * np.asarray(half, float) / volume.shape
    return InitialCloud(
        points,
        rescale * volume.ravel()[chosen].astype(float),
        neighbour_distance(points, fallback=size.min()),
        {'method': 'r2', 'threshold': threshold, 'cells': len(cells), 'seconds': time.perf_counter() - begun},
    )
