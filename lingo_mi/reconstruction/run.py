"""Runs algorithms, with checks before, and shows their progress."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from lingo_mi.common import progress as bars
from lingo_mi.common.errors import InputError
from lingo_mi.effects.forward import effects_of
from lingo_mi.files.slabs import write_slabs
from lingo_mi.files.units import PER_MM, Unit
from lingo_mi.geometry.base import Geometry
from lingo_mi.jobs.job import Runner
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.asd_pocs import ASDPOCS
from lingo_mi.reconstruction.fdk import FDK
from lingo_mi.reconstruction.memory_needs import memory_needed
from lingo_mi.reconstruction.preconditions import require_signal
from lingo_mi.reconstruction.sart import Sweeps
from lingo_mi.reconstruction.slab_cluster import fdk_on, sweep_on
from lingo_mi.reconstruction.slab_volume import discard, work_folder
from lingo_mi.scan import Scan
from lingo_mi.scene.checks import check_memory

InSlabs = FDK | Sweeps | ASDPOCS  # these need not hold the whole volume
MOST_ENTRIES = 2**32  # of an array of Dr.Jit


def run_algorithm(
    scan: Scan, algorithm: Algorithm, *, start: ArrayLike | None = None, progress: Progress | None = None, **inputs: Any
) -> Reconstruction:
    """Reconstruct a scan with an algorithm, after checks of the memory and of the signal.

    Parameters
    ----------
    scan : Scan
        A scan whose projections are line integrals: take a detector's effects out before (`line_integrals.line_integrals`).
    algorithm : Algorithm
        With its options.
    start : array, optional
        Volume [x, y, z] to start from, density per mm: an array or another `Reconstruction` (default: zero).
    progress : callable, optional
        Called as progress(steps done, `algorithm.steps`, residual or None) after every step.
    inputs
        Further arguments of this algorithm's `_run`, such as `weights`, or `sample` and `completed` of `Refined`.

    Raises
    ------
    InputError
        As `check_room` and `require_signal` do, for a start that the algorithm does not take or that does not fit the geometry,
        and if the result is not finite.
    """
    effects = effects_of(scan)
    if effects is not None and not effects.ideal:
        raise InputError(
            'the projections are not line integrals, because the scan has effects: take line_integrals(scan) of '
            'lingo_mi.reconstruction.line_integrals'
        )
    if start is not None and algorithm.no_start:
        raise InputError(algorithm.no_start)
    views = max(len(scan), len(inputs.get('completed') or ()))
    check_room(scan.geometry, algorithm, views, mask_images(scan))
    require_signal(scan)
    return algorithm._run(scan, start=start, progress=progress, **inputs)


def run_in_slabs(
    scan: Scan,
    algorithm: InSlabs,
    path: Path,
    thickness: int,
    progress: Progress | None = None,
    runner: Runner | None = None,
    unit: Unit = PER_MM,
) -> None:
    """Reconstruct a scan in slabs of `thickness` slices, and write each to a file of the volume, which need not fit into memory.

    Iterative algorithms hold the volume in a folder beside the file, whose name ends in .slabs, until the file is written. If the
    work is stopped, the same call goes on.

    Parameters
    ----------
    progress : Progress or None
        Called as progress(steps done, `algorithm.slab_steps`, residual or None).
    runner : Runner or None
        Of workers that make the slabs and write them, see `slab_cluster` (None: this process).
    unit : Unit
        Unit of the values in the file, for this process.
    """
    require_signal(scan)
    path = path.absolute()  # workers have other working directories
    work = work_folder(path)
    if isinstance(algorithm, FDK):
        if runner is not None:
            fdk_on(runner, algorithm, scan, thickness, work, path, progress)
        else:
            return write_slabs(path, scan.geometry.grid, algorithm.slabs(scan, thickness, progress=progress), unit)
    elif runner is not None:
        sweep_on(runner, scan, algorithm.plan(scan), thickness, work, path, progress)
    else:
        write_slabs(path, scan.geometry.grid, algorithm.slabs(scan, thickness, work, progress=progress), unit)
    discard(work)  # not before the volume is safe


def mask_images(scan: Scan) -> int:
    """Bytes of the images that projectors keep of a scan's invalid pixels."""
    return 0 if scan.valid is None else 4 * scan.valid.size


def check_room(
    geometry: Geometry, algorithm: Algorithm | None = None, views: int | None = None, beside: float = 0
) -> None:
    """Raises InputError if memory or an array is too small.

    Parameters
    ----------
    algorithm : Algorithm or None
        Algorithm to check for (None: the least that any algorithm needs).
    views : int or None
        Number of views to reconstruct from (None: the geometry's own).
    beside : float
        Bytes that are held beside what the algorithm needs, such as `mask_images`.
    """
    views = views or len(geometry)
    fine, pixels = geometry, 0
    if algorithm is not None:
        fine = geometry.on(algorithm.grid(geometry))
        if algorithm.name != 'fdk':
            pixels = views * math.prod(geometry.nDetector)
    for number, what in (math.prod(fine.grid.shape), 'voxels'), (pixels, 'pixels in all views'):
        if number >= MOST_ENTRIES:
            raise InputError(
                f'{number:.4g} {what} are more than an array can hold, 2^32; take larger ones, or give slab=64'
            )
    if algorithm is None:
        check_memory(geometry, views=views)
    else:
        check_memory(fine, views=views, needed=room_needed(geometry, algorithm, views, beside))


def room_needed(geometry: Geometry, algorithm: Algorithm, views: int, beside: float = 0) -> float:
    """Bytes of peak memory by which `check_room` refuses, whose arguments these are."""
    geometry = geometry.on(algorithm.grid(geometry))
    more = 4 * algorithm.volumes * math.prod(geometry.grid.shape)
    return memory_needed(algorithm.name, geometry, views) + more + beside


@contextmanager
def progress_bar(
    algorithm: Algorithm, scan: Scan, label: str | None = None, *, steps: int | None = None, shown: bool = True
) -> Iterator[Progress]:
    """A `progress` function that shows a bar on standard error.

    Parameters
    ----------
    label : str or None
        Before the bar (default: the algorithm's name).
    steps : int or None
        Number of all steps (default: the steps of `run_algorithm`).
    shown : bool
        False: draw nothing.

    Examples
    --------
    >>> with progress_bar(algorithm, scan) as progress:
    ...     found = run_algorithm(scan, algorithm, progress=progress)
    """
    with bars.Progress(label or algorithm.name, steps or algorithm.steps(scan), shown=shown) as bar:
        yield lambda done, _, residual: bar.update(done, residual=residual)
