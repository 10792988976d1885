"""Fitting a cloud of Gaussians to a scan in one call."""

from __future__ import annotations

import tempfile
from contextlib import nullcontext
from os import PathLike
from pathlib import Path
from typing import Any

from lingo_mi.api.result import Result
from lingo_mi.common import parsing
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.fitting.recipes import settings_of
from lingo_mi.fitting.settings import Settings
from lingo_mi.results.watched_fit import watched_fit
from lingo_mi.results.watchers import watchers_of
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import check_memory
from lingo_mi.storage.file_access import as_path, require_writable, writing
from lingo_mi.storage.folder_lock import LOCK, locked
from lingo_mi.storage.output_folder import CHECKPOINT


def fit(
    scan: Scan | Dataset,
    recipe: str | Settings = 'fast',
    *,
    seed: int = 0,
    checkpoint: str | PathLike | None = None,
    resume: bool = False,
    progress: bool = True,
    live: bool = False,
    log_dir: str | PathLike | None = None,
    **settings: Any,
) -> Result:
    """Fit a cloud of 3D Gaussians, or a neural field, to a scan.

    scan         the views to fit; of a `Dataset` these are `train`, and quality on its held-out views and true volume is
                 measured on the way
    recipe       'fast' (this project's own), 'lingo' or 'r2' (the published ones), '3dgs' or 'xgaussian' (baselines that
                 composite opacities: they make views, but no volume) or 'naf' (a neural field), with changes as in
                 'lingo:V_S=1'; or `Settings`
    seed         of every random choice
    checkpoint   a file (.npz) written every 30 s and at the end; what `resume` goes on from
    resume       go on from the checkpoint, as if it had never stopped; the scan and all settings must be the same
    progress     whether to show a progress bar on standard error
    live         whether to serve a page that grows while the fit runs, to this machine alone; its address is printed, and in a
                 notebook the page is shown below the cell
    log_dir      a folder for TensorBoard's events: numbers, slices, views (needs the extra 'tensorboard')
    settings     any setting of the fit by name, such as iterations=800, n_points=20_000 or lambda_tv=0.1 (see `Settings`)

    Returns a `Result`. Ctrl-C stops between two steps and leaves a checkpoint, where one is named. Raises InputError for an
    unknown recipe or setting, a scan without signal or larger than memory, a checkpoint of another fit or that cannot be
    written, and a fit that diverges.

        result = lm.fit(data, 'fast', checkpoint='out/foot.npz')
    """
    ensure_variant()
    require_type('scan', scan, (Scan, Dataset))
    require_type('recipe', recipe, (str, Settings))
    seed = parsing.seed(seed)
    dataset = scan if isinstance(scan, Dataset) else Dataset(scan)
    check_memory(dataset.train.geometry)
    if isinstance(recipe, Settings):
        name, chosen = 'settings', recipe.changed(**settings)
    else:
        name, chosen = recipe, settings_of(recipe, **settings)
    path = None if checkpoint is None else as_path('checkpoint', checkpoint)
    if resume and path is None:
        raise InputError('resume=True needs the checkpoint to go on from: give checkpoint=FILE')
    if path is not None:
        with writing(path):
            if path.is_dir():
                raise InputError(f'{path}: is a folder; name a file in it, such as {path / CHECKPOINT}')
            if path.is_symlink():
                raise InputError(f'{path}: is a link, which is not written to; name the file itself')
            if path.exists() and not resume:
                raise InputError(f'{path}: exists already; give resume=True to go on from it, or remove it')
        require_writable(path.parent, path)
    with _lock(path), tempfile.TemporaryDirectory() as folder:
        # Kept even where nobody names a file: `Result.save` writes it.
        file = Path(folder) / CHECKPOINT if path is None else path
        watchers = watchers_of(dataset.train.geometry, live, log_dir, name)
        with Progress('Fit', chosen.iterations, shown=progress) as bar:
            fitted = watched_fit(dataset, chosen, seed, bar.update, watchers, file, resume)
        return Result(fitted, name, file.read_bytes(), dataset)


def _lock(path: Path | None):
    """Keeps other processes from writing a checkpoint; its folder may hold those of several fits."""
    if path is None:
        return nullcontext()
    return locked(path.parent, LOCK if path.name == CHECKPOINT else f'{LOCK}-{path.name}')
