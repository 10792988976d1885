"""Reconstruction on voxels in one call."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.api.result import Result
from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.completion.clouds import FittedCloud
from lingo_mi.completion.prepare import fit_cloud, prepare_completed, prepare_start
from lingo_mi.reconstruction import Algorithm, Best, Reconstruction, Refined, check_scan, progress_bar
from lingo_mi.reconstruction import reconstruct as run
from lingo_mi.reconstruction.effects_correction import linearised
from lingo_mi.scan import Dataset, Scan


def reconstruct(
    scan: Scan | Dataset,
    algorithm: Algorithm,
    *,
    start: Result | ArrayLike | None = None,
    views: int | None = None,
    progress: bool = True,
) -> Reconstruction:
    """Reconstruct a volume on the voxels of a scan's geometry.

    scan        projections and geometry; of a `Dataset` its `train`. Effects that it knows are taken out first: beam hardening,
                scatter, dead pixels; blur together with scatter, or with a result to start from
    algorithm   one of `FDK`, `SART`, `OSSART`, `SIRT`, `CGLS`, `ASDPOCS`, `Refined`, `Best`, with its parameters
    start       the `Result` of a fit to this scan, or a volume [x, y, z] in 1/mm, to start from; `Refined` needs a result
    views       with a result: how many views to reconstruct from. Those that were not measured are rendered from the cloud (the
                two stages of the paper), and the algorithm starts from nothing. The scan must be one on a circle
    progress    whether to show a progress bar on standard error

    `Best` chooses its settings by measured views that it holds out, and takes neither `start` nor `views`; with
    `cloud` it fits a cloud by itself.
    `Refined` meets the completed views first where `views` is given, and the measured ones alone where it is not.

    Returns a `Reconstruction`: `volume` float32 [x, y, z], density per mm; `residuals` |A x - b| / |b|, NaN for passes where it
    was not computed; `seconds`. It can be used as an array. Raises InputError for a scan or a start that the algorithm cannot
    use, and where memory does not suffice.

        found = lm.reconstruct(data.train, lm.SART(niter=20), start=result)
        found.volume, found.residuals[-1]
    """
    ensure_variant()
    scan = scan.train if isinstance(scan, Dataset) else scan
    require_type('scan', scan, (Scan, Dataset))
    if views is not None:
        views = whole('views', views, 1)
    if isinstance(start, str | PathLike):
        raise InputError(
            f'start must be the Result of a fit, or a volume, not a path: give lm.load_result({str(start)!r})'
        )
    if not isinstance(algorithm, Algorithm):
        raise InputError(f'algorithm must be an object such as lm.SART(niter=20), not {algorithm!r}')
    inputs: dict[str, Any] = {}
    if isinstance(start, Result):
        cloud, dataset = FittedCloud.of(start.fitted), Dataset(scan)
        if views is not None:
            check_scan(scan.geometry, algorithm, views)
            scan, inputs = prepare_completed(dataset, cloud, views, algorithm)
        else:
            if isinstance(algorithm, Refined):
                algorithm = replace(algorithm, completed_niter=0)
            scan, inputs = prepare_start(dataset, cloud, algorithm)
    elif views is not None:
        raise InputError('views are rendered from a fitted cloud: give the result of a fit as start')
    elif isinstance(algorithm, Refined):
        raise InputError('Refined starts from a fitted cloud: give the result of a fit as start')
    else:
        if scan.effects is not None:
            scan = linearised(scan, scan.effects)
        inputs = {} if start is None else dict(start=as_numpy(start, 'the start volume', np.float32))
        if isinstance(algorithm, Best):
            inputs['fit'] = fit_cloud
    with progress_bar(algorithm, scan) if progress else nullcontext() as bar:
        return run(scan, algorithm, progress=bar, **inputs)
