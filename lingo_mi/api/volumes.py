"""Reconstruction on voxels in one call."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from math import prod
from os import PathLike
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.parsing import whole_number
from lingo_mi.common.runtime import drjit_lock, ensure_variant
from lingo_mi.completion.prepare import fit_cloud, prepare_completed, prepare_start
from lingo_mi.effects.forward import effects_of
from lingo_mi.files.slabs import THICKNESS, check_volume_name, plan_and_error_map, require_whole_chunks
from lingo_mi.files.units import PER_MM, Unit, unit_of
from lingo_mi.fitting.fit import Fit
from lingo_mi.inspection.measure import warn_of_intensities
from lingo_mi.jobs.cluster import workers
from lingo_mi.reconstruction import Algorithm, Best, Reconstruction, Refined
from lingo_mi.reconstruction.line_integrals import line_integrals
from lingo_mi.reconstruction.preconditions import require_rays, require_signal
from lingo_mi.reconstruction.run import InSlabs, check_room, mask_images, progress_bar, run_algorithm, run_in_slabs
from lingo_mi.scan import Dataset, Scan
from lingo_mi.storage.file_access import as_path, check_new_file, writing
from lingo_mi.storage.folder_lock import writing_file


@overload
def reconstruct(
    scan: Scan | Dataset,
    algorithm: Algorithm,
    *,
    start: Fit | ArrayLike | None = None,
    views: int | None = None,
    out: str | PathLike | None = None,
    units: str = '1/mm',
    mu_water: float | None = None,
    slab: None = None,
    force: bool = False,
    progress: bool = True,
) -> Reconstruction: ...


@overload
def reconstruct(
    scan: Scan | Dataset,
    algorithm: Algorithm,
    *,
    start: Fit | None = None,
    views: int | None = None,
    out: str | PathLike,
    units: str = '1/mm',
    mu_water: float | None = None,
    slab: int | None = None,
    cluster: Any = None,
    force: bool = False,
    progress: bool = True,
) -> Path: ...


@drjit_lock()
def reconstruct(
    scan: Scan | Dataset,
    algorithm: Algorithm,
    *,
    start: Fit | ArrayLike | None = None,
    views: int | None = None,
    out: str | PathLike | None = None,
    units: str = '1/mm',
    mu_water: float | None = None,
    slab: int | None = None,
    cluster: Any = None,
    force: bool = False,
    progress: bool = True,
) -> Reconstruction | Path:
    """Reconstruct a volume on the voxels of a scan's geometry.

    Parameters
    ----------
    scan : Scan or Dataset
        Projections and geometry. Of a `Dataset`, `train` is used. The effects that the scan declares are corrected first: beam
        hardening, scatter, dead pixels, and blur if there is scatter or a fit to start from. `dataclasses.replace(scan,
        effects=None)` treats the projections as line integrals.
    algorithm : Algorithm
        `FDK`, `SART`, `OSSART`, `SIRT`, `CGLS`, `ASDPOCS`, `PenalisedLeastSquares`, `Refined` or `Best`, with its options. `Best`
        takes neither `start` nor `views`.
    start : Fit or array, optional
        A fit to this scan, or a volume [x, y, z] in 1/mm, to start from. `Refined` needs one.
    views : int, optional
        How many views to reconstruct from, with a fit as `start`. The fit only renders the views that were not measured (the
        second stage of the paper), and the volume starts empty, except for `Refined`. The scan must be on a circle. `Refined`
        uses these views first, and then the measured ones. Without `views`, it uses the measured ones alone.
    out : path, optional
        Write the volume there (.nii, .nii.gz, .ome.zarr or .dicom), as `Reconstruction.save` does.
    units, mu_water
        Units of the values in that file: '1/mm', '1/cm', or 'hu' with the attenuation of water in 1/mm (`Reconstruction.save`).
    slab : int, optional
        Number of slices in a slab. `FDK`, `SART`, `OSSART`, `SIRT` and `ASDPOCS` then make the volume slab by slab and write each
        to `out`, so the volume need not fit into memory. While they work, iterative algorithms store the volume in a folder
        beside `out`, whose name ends in .slabs. If they are stopped, the same call continues.
    cluster : str or Client, optional
        A Dask cluster whose workers make the slabs (default: of 64 slices) and write them to `out`, an .ome.zarr. The cluster
        is the scheduler's address or file, 'local:N' for N processes of this machine, or a client of `distributed`. Workers must
        see the folder of `out`. The volume is the same as on one process. If a worker dies, another makes its slab.
    force : bool
        Replace an earlier file.
    progress : bool
        Show a progress bar on standard error.

    Returns
    -------
    Reconstruction or Path
        The reconstruction can be used as an array. It has `volume`, float32 [x, y, z], density per mm; `residuals`,
        |A x - b| / |b| of each pass, NaN if it was not computed; and `seconds`. With `slab` or `cluster`: the path of the volume.

    Raises
    ------
    InputError
        For a scan or a start that the algorithm cannot use, too little memory, and a file that exists or cannot be written.

    Examples
    --------
    ::

        result = lm.reconstruct(data.train, lm.SART(niter=20), start=fit)
        result.volume, result.residuals[-1]
    """
    ensure_variant()
    require_type('scan', scan, (Scan, Dataset))
    views = None if views is None else whole_number('views', views, 1)
    if cluster is not None and slab is None:
        slab = THICKNESS
    slab = None if slab is None else whole_number('slab', slab, 1)
    path = None if out is None else as_path('out', out)
    start, unit = _start(start), unit_of(units, mu_water)
    if path is None and unit != PER_MM:
        raise InputError(f'units={units!r} is for files, and a volume in memory is per mm: give out=FILE')
    _check(algorithm, start, views, path, slab)
    if path is not None:
        _check_output(path, algorithm, force, unit)
    truth = scan.volume if isinstance(scan, Dataset) else None
    scan = scan.train if isinstance(scan, Dataset) else scan
    require_rays(scan.geometry)
    require_signal(scan)
    if truth is None:  # else it is simulated, as a rule
        warn_of_intensities(scan)
    if cluster is not None and path is not None and slab is not None:
        require_whole_chunks(path, slab, unit)
    if slab is None:  # else the slabs are checked
        seen = views or (len(start.nominal_geometry) if isinstance(start, Fit) else None)
        # The needs count only one of these two volumes.
        both = 0 if truth is None or start is None else 4 * prod(scan.geometry.grid.shape)
        check_room(scan.geometry, algorithm, seen, mask_images(scan) + both)
    with nullcontext() if path is None else writing_file(path):
        scan, algorithm, inputs = _prepared(scan, algorithm, start, views)
        if path is not None and slab is not None:
            assert isinstance(algorithm, InSlabs)  # see `_check`
            with (
                nullcontext() if cluster is None else workers(cluster, path) as runner,
                progress_bar(algorithm, scan, steps=algorithm.slab_steps(scan, slab), shown=progress) as bar,
            ):
                run_in_slabs(scan, algorithm, path, slab, bar, runner, unit)
            return path
        with progress_bar(algorithm, scan, shown=progress) as bar:
            result = run_algorithm(scan, algorithm, progress=bar, **inputs)
        if path is not None:
            result.save(path, units=units, mu_water=mu_water, force=force)
    return result


def _start(start: Any) -> Fit | np.ndarray | None:
    if start is None or isinstance(start, Fit):
        return start
    if isinstance(start, str | PathLike):
        raise InputError(f'start must be a fit, or a volume, not a path: give lm.load_fit({str(start)!r})')
    return as_numpy(start, 'the start volume', np.float32)


def _check(algorithm: Any, start: Fit | np.ndarray | None, views: int | None, path: Path | None, slab: int | None):
    """Raises InputError for arguments that contradict each other."""
    if not isinstance(algorithm, Algorithm):
        raise InputError(f'algorithm must be an object such as lm.SART(niter=20), not {algorithm!r}')
    if views is not None and not isinstance(start, Fit):
        raise InputError('views are rendered from a fitted cloud: give the fit as start')
    if start is None and isinstance(algorithm, Refined):
        raise InputError('refined starts from a fitted cloud: give the fit, or its volume, as start')
    if start is not None and algorithm.no_start and (views is None or isinstance(algorithm, Best)):
        raise InputError(algorithm.no_start)
    if slab is None:
        return
    if path is None:
        raise InputError('a volume in slabs is written while it is made: give out=FILE')
    if not isinstance(algorithm, InSlabs):
        raise InputError(
            f'slabs are for fdk, sart, os-sart, sirt and asd-pocs; {algorithm.name} needs the whole volume: '
            'leave out slab and cluster'
        )
    if start is not None and views is None:
        raise InputError('a volume in slabs starts empty: leave out start, or slab and cluster')


def _check_output(path: Path, algorithm: Algorithm, force: bool, unit: Unit) -> None:
    """Raises InputError, before any work, if the volume cannot be written."""
    with writing(path):
        check_volume_name(path, unit)
        for file in (path, *(plan_and_error_map(path) if isinstance(algorithm, Best) else ())):
            check_new_file(file, force)


def _prepared(
    scan: Scan, algorithm: Algorithm, start: Fit | np.ndarray | None, views: int | None
) -> tuple[Scan, Algorithm, dict[str, Any]]:
    """The line integrals that the volume is made of, the algorithm, and what else this one needs."""
    algorithm = algorithm.seeing(effects_of(scan))
    if isinstance(start, Fit) and views is not None:
        scan, inputs = prepare_completed(scan, start, views, algorithm)
        return scan, algorithm, inputs
    if isinstance(algorithm, Refined):  # there are no completed views
        algorithm = replace(algorithm, completed_niter=0)
    if isinstance(start, Fit):
        scan, inputs = prepare_start(scan, start, algorithm)
        return scan, algorithm, inputs
    scan = line_integrals(scan)
    if isinstance(algorithm, Best):
        return scan, algorithm, dict(fit=fit_cloud)
    return scan, algorithm, dict(start=start)
