"""The volume of a fit in slabs, on the workers of a cluster."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from lingo_mi.files.slabs import shared_zarr, write_chunks
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fitted_model import FittedModel
from lingo_mi.geometry.grid import Grid
from lingo_mi.jobs.job import Job, Runner, run_or_refuse
from lingo_mi.storage.output_folder import CHECKPOINT


def voxelize_on(runner: Runner, fit: FittedModel, grid: Grid, thickness: int, path: Path) -> None:
    """Write `fit.volume(grid)` as OME-Zarr, each slab by a worker, who reads the fit from a checkpoint beside it.

    Raises
    ------
    InputError
        If a slab fails twice, or the file cannot be written.
    """
    fit.volume(grid.slab(0, 1))  # refuses, here, a method without a volume
    with shared_zarr(path, grid) as target:
        checkpoint = target / 'fit' / CHECKPOINT
        checkpoint.parent.mkdir()
        fit.checkpoint.save(checkpoint)
        parts = enumerate(grid.slabs(thickness))
        jobs = [Job(f'slab {k}', 1, voxelize_slab, (checkpoint, grid.slab(*p), p[0], target)) for k, p in parts]
        run_or_refuse(jobs, runner)
        shutil.rmtree(checkpoint.parent)


def voxelize_slab(checkpoint: Path, slab: Grid, begin: int, target: Path, *, report: Callable[..., None]) -> None:
    """Write the density of a stored fit on the voxels of a slab to the OME-Zarr."""
    report(0)
    stored = Checkpoint.load(checkpoint)
    model = stored.method.model(stored.geometry, stored.unit, None)  # effects change no density
    write_chunks(target, begin, FittedModel(stored, model).volume(slab))
