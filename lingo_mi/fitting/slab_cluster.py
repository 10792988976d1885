"""The volume of a fit in slabs, on the workers of a cluster."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from lingo_mi.files.slabs import SharedZarr, shared_zarr
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fitted_model import FittedModel
from lingo_mi.geometry.grid import Grid
from lingo_mi.jobs.job import Runner
from lingo_mi.reconstruction.slab_cluster import claim, deliver_on, exchange_folder
from lingo_mi.reconstruction.slab_volume import discard, work_folder
from lingo_mi.storage.folder_lock import locked


def voxelize_on(runner: Runner, fit: FittedModel, grid: Grid, thickness: int, path: Path) -> None:
    """Let workers write `fit.volume(grid)` as OME-Zarr. They read the fit from a checkpoint beside it.

    If the work is stopped, the same call makes only those slabs that are missing.

    Raises
    ------
    InputError
        If a slab fails twice, the file cannot be written, or its folder holds slabs of other work.
    """
    fit.volume(grid.slab(0, 1))  # refuses a method without a volume in this process
    folder = work_folder(path)
    with locked(folder), exchange_folder(folder) as exchange:
        checkpoint = exchange / 'fit.npz'
        fit.checkpoint.save(checkpoint)
        with np.load(checkpoint) as entries:
            claim(folder, repr((str(entries['checksum']), grid, thickness)))
        with shared_zarr(path, grid, folder) as target:
            deliver_on(runner, grid.slabs(thickness), target, voxelize_slab, (checkpoint, grid))
    discard(folder)


def voxelize_slab(
    target: SharedZarr, part: tuple[int, int], checkpoint: Path, grid: Grid, *, report: Callable[..., None]
) -> None:
    """Write the density of a stored fit on the voxels of a slab to the OME-Zarr."""
    report(0)
    stored = Checkpoint.load(checkpoint)
    model = stored.method.model(stored.geometry, stored.unit, None)  # effects change no density
    target.write(part[0], FittedModel(stored, model).volume(grid.slab(*part)))
