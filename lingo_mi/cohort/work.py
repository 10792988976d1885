"""The fit of one scan of a cohort, into the folder of its name."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from lingo_mi.api.fitting import fit
from lingo_mi.cohort.row import Row, stored
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan
from lingo_mi.files.volumes import read_volume
from lingo_mi.scan import Dataset
from lingo_mi.scene.checks import check_memory, warn_if_truncated
from lingo_mi.scene.load import load_scene
from lingo_mi.scene.simulate import choose_views, take_scan
from lingo_mi.storage.folder_lock import locked
from lingo_mi.storage.output_folder import CHECKPOINT

PATIENCE = 60.0  # seconds: a worker that has lost its scheduler stops after its step, and writes its checkpoint


def fit_row(row: Row, out: str, *, report: Callable[..., None]) -> dict:
    """Fit a row's scan into the folder `out`/NAME: from its checkpoint, if there is one. Returns the metrics of the result.

    Finished work is not done again.

    Parameters
    ----------
    report : callable
        Called between steps; after its KeyboardInterrupt, and after a kill, the same call goes on.

    Raises
    ------
    InputError
        If the scan cannot be fitted.
    """
    folder, scan = Path(out) / row.name, read_row(row)
    _wait_for_lock(folder, report)
    if (done := stored(Path(out), row)) is not None:
        return done
    return fit(
        scan,
        row.fit_method(),
        seed=row.seed,
        folder=folder,
        resume=(folder / CHECKPOINT).exists(),
        force=True,
        title=row.name,
        progress=report,
        note=dict(request=row.request()),
    ).record


def read_row(row: Row) -> Dataset:
    """The scan of a row: its projections, or what the scene's scanner sees of its volume. Raises InputError."""
    scene = row.scene
    if scene is not None:
        volume = None if row.path is None else read_volume(row.path, row.mu_water)
        return take_scan(load_scene(scene, row.parameters), row.views or 0, volume, row.seed)
    if row.path is None:
        raise InputError(f'{row.name}: has no file')
    geometry = Path(row.folder) / row.geometry if row.geometry else None
    dataset = choose_views(read_scan(row.path, geometry), row.views or 0)
    check_memory(dataset.train.geometry)
    warn_if_truncated(dataset.train.geometry)
    return dataset


def _wait_for_lock(folder: Path, report: Callable[..., None]) -> None:
    """Wait until a process that is about to stop has let go of the folder."""
    ends = time.monotonic() + PATIENCE
    while True:
        try:
            with locked(folder):
                return
        except InputError:
            if time.monotonic() > ends:
                raise
        report(0)
        time.sleep(0.2)
