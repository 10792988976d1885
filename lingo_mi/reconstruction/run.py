"""Runs algorithms, with checks before and a progress bar."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numpy.typing import ArrayLike

from lingo_mi.common import progress as bars
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import one_at_a_time
from lingo_mi.geometry.base import Geometry
from lingo_mi.reconstruction.algorithm import Algorithm, Progress, Reconstruction
from lingo_mi.reconstruction.memory_needs import needed
from lingo_mi.reconstruction.preconditions import require_rays, require_signal
from lingo_mi.scan import Scan
from lingo_mi.scene.checks import check_memory

MOST_ENTRIES = 2**32  # of one of Dr.Jit's arrays


@one_at_a_time()
def reconstruct(
    scan: Scan, algorithm: Algorithm, *, start: ArrayLike | None = None, progress: Progress | None = None, **inputs: Any
) -> Reconstruction:
    """Reconstruct a scan with an algorithm, after checks of the memory and of the scan.

        found = reconstruct(scan, ASDPOCS(niter=20))
        better = reconstruct(scan, SART(niter=5), start=found)

    scan       projections and geometry. Projections must be line integrals: remove a detector's effects before
               (`effects_correction.linearised`)
    algorithm  with its options
    start      volume [x, y, z] to start from, density per mm (default: zero)
    progress   called as progress(steps done, steps, residual or None) after every step
    inputs     further arguments of this algorithm's `run`, such as `weights`, or `sample` and `completed` of `Refined`

    Raises InputError as `check_scan` and `require_signal` do, for a start that does not fit the geometry, and if the result
    is not finite.
    """
    views = max(len(scan), len(inputs.get('completed') or ()))
    check_scan(scan.geometry, algorithm, views, mask_images(scan))
    require_signal(scan)
    return algorithm.run(scan, start=start, progress=progress, **inputs)


def mask_images(scan: Scan) -> int:
    """Bytes of the images that projectors keep of a scan's invalid pixels."""
    return 0 if scan.valid is None else 4 * scan.valid.size


def check_scan(
    geometry: Geometry, algorithm: Algorithm | None = None, views: int | None = None, beside: float = 0
) -> None:
    """Raises InputError if no ray meets the volume, if the source is inside it, or if memory is too small.

    algorithm   to check memory for (None: the least that any algorithm needs)
    views       number of views to reconstruct from (None: the geometry's own)
    beside      bytes that are held beside what the algorithm needs, such as `mask_images`
    """
    require_rays(geometry)
    check_room(geometry, algorithm, views, beside)


def check_room(
    geometry: Geometry, algorithm: Algorithm | None = None, views: int | None = None, beside: float = 0
) -> None:
    """Raises InputError if memory or an array is too small; arguments as of `check_scan`."""
    views = views or len(geometry)
    grid, pixels = geometry, 0
    if algorithm is not None:
        grid = algorithm.grid(geometry)
        if algorithm.name != 'fdk':
            pixels = views * math.prod(geometry.nDetector)
    for number, what in (math.prod(grid.nVoxel), 'voxels'), (pixels, 'pixels in all views'):
        if number >= MOST_ENTRIES:
            raise InputError(
                f'{number:.4g} {what} are more than an array can hold, 2^32; take larger ones, or slabs (--slab)'
            )
    if algorithm is None:
        check_memory(geometry, views=views)
    else:
        check_memory(grid, views=views, needed=needed(algorithm.name, grid, views) + beside)


@contextmanager
def progress_bar(algorithm: Algorithm, scan: Scan, label: str | None = None) -> Iterator[Progress]:
    """A `progress` function that shows a bar on standard error.

        with progress_bar(algorithm, scan) as progress:
            found = reconstruct(scan, algorithm, progress=progress)

    label   before the bar (default: the algorithm's name)
    """
    with bars.Progress(label or algorithm.name, algorithm.steps(scan)) as bar:
        yield lambda done, _, residual: bar.update(done, residual=residual)
