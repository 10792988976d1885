"""A fit into a folder, from the first step or from the checkpoint that is there, to the whole result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from lingo_mi.fitting.settings import Settings
from lingo_mi.results.measure import measure
from lingo_mi.results.save import result_names, save
from lingo_mi.results.watch import Watcher
from lingo_mi.results.watched_fit import watched_fit
from lingo_mi.scan import Dataset
from lingo_mi.storage.output_folder import CHECKPOINT, require_ours


def fit_into(
    folder: Path,
    dataset: Dataset,
    settings: Settings,
    seed: int,
    progress: Callable[..., None],
    *,
    resume: bool = False,
    title: str,
    method: str,
    command: str = '',
    request: dict | None = None,
    watchers: Sequence[Watcher] = (),
) -> dict:
    """Fit a scan, measure the fit, and write all files of the result; returns its metrics.

    folder     which no other process writes to
    progress   as of `watched_fit`
    resume     from the checkpoint in the folder
    request    what was asked for, kept in metrics.json
    watchers   of the fit, such as a live page

    title, method, command   as of `save`

    Raises InputError where the fit or the folder does not work out.
    """
    require_ours(folder, result_names(settings, 0 if dataset.test is None else len(dataset.test)))
    fit = watched_fit(dataset, settings, seed, progress, watchers, folder / CHECKPOINT, resume)
    measured = measure(fit, dataset.test, dataset.volume)
    return save(folder, fit, measured, title=title, method=method, command=command, request=request)
