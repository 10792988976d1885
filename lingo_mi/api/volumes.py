"""Reconstruction on voxels in one call."""

from __future__ import annotations

import numpy as np

from lingo_mi.api.result import Result
from lingo_mi.reconstruction import Algorithm, Reconstruction
from lingo_mi.runtime import ensure_variant
from lingo_mi.scan import Scan


def reconstruct(
    scan: Scan, algorithm: Algorithm, *, start: Result | np.ndarray | None = None, progress: bool = True
) -> Reconstruction:
    """Reconstruct a volume on the voxels of a scan's geometry.

    scan        projections and geometry
    algorithm   one of `FDK`, `SART`, `OSSART`, `SIRT`, `CGLS`, `ASDPOCS`, `Refined`, with its parameters
    start       the `Result` of a fit, or a volume [x, y, z], to start from; `Refined` needs a result, `FDK` takes none
    progress    whether to show a progress bar on standard error

    Returns a `Reconstruction`: `volume` float32 [x, y, z], density per mm; `residuals` |A x - b| / |b|; `seconds`. It can be
    used as an array. Raises InputError for a scan or a start that the algorithm cannot use, and where memory does not suffice.

        volume = lm.reconstruct(data.train, lm.SART(niter=20), start=result).volume
    """
    ensure_variant()
