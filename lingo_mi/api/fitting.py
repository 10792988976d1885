"""Fitting a scan in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from os import PathLike
from typing import Any

from lingo_mi.common import parsing
from lingo_mi.common.errors import InputError, require_type
from lingo_mi.common.interrupts import between_steps
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import ensure_variant
from lingo_mi.files.units import unit_of
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.hold_out import with_held_out
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measure import few_views, quick_measure
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.fitting.save import result_names
from lingo_mi.inspection.measure import warn_of_intensities
from lingo_mi.jobs.cluster import opened
from lingo_mi.results.watch import watched
from lingo_mi.results.watchers import watchers_of
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import check_memory
from lingo_mi.storage.file_access import as_path
from lingo_mi.storage.folder_lock import locked
from lingo_mi.storage.output_folder import CHECKPOINT, clear_leftovers, require_ours, result_folder


def fit(
    scan: Scan | Dataset,
    method: str | Method = 'fast',
    *,
    hold_out: int | None = None,
    seed: int = 0,
    folder: str | PathLike | None = None,
    resume: bool = False,
    force: bool = False,
    title: str = '',
    units: str = '1/mm',
    mu_water: float | None = None,
    progress: bool | Callable[..., None] = True,
    live: bool = False,
    log_dir: str | PathLike | None = None,
    cluster: Any = None,
    note: dict | None = None,
    **options: Any,
) -> Fit:
    """Fit a cloud of 3D Gaussians, or a neural field, to a scan.

    Parameters
    ----------
    scan : Scan or Dataset
        The views to fit. Of a `Dataset`, `train` is fitted, and the fit measures its quality on the held-out views and the true
        volume.
    method : Method or str
        `Fast` (the default), `LINGO` or `R2` (published methods), `GaussianSplatting` or `XGaussian` (baselines that use alpha
        compositing, and so make views but no volume), `NAF` (a neural field), or a method that you wrote. A string names the
        method and its options: 'lingo:V_S=1'.
    hold_out : int or None
        One view in `hold_out` is not fitted, and measures how well the fit predicts unseen views. 0 fits all views. The default
        is 10 for a `Dataset` of 20 views or more that has neither held-out views nor a true volume, and otherwise 0.
    seed : int
        Seed of every random choice.
    folder : path, optional
        Folder of the result. The fit writes a checkpoint there every 30 s, and at the end the files of `Fit.save`.
    resume : bool
        Continue from the checkpoint in the folder, as if the fit had never stopped. Scan and options must be the same.
    force : bool
        Replace an earlier result in the folder.
    title : str
        Title of the report (default: the folder's name).
    units, mu_water
        Units of the volume in the folder, as in `Fit.save`.
    progress : bool or callable
        Whether to show a progress bar on standard error, or a function that `fitting.loop.run` calls between steps.
    live : bool
        Serve a page that grows while the fit runs. Only this machine can open it. The fit prints its address; a notebook shows
        the page.
    log_dir : path, optional
        A folder for TensorBoard's events: numbers, slices, views (needs the extra 'tensorboard').
    cluster : str or Client, optional
        A Dask cluster whose workers render and differentiate the views of each step. A step must have several views: batch=N,
        one or more for each worker. The cluster is the scheduler's address or file, 'local:N' for N processes of this machine,
        or a client of `distributed`. The result is the same as on one process, up to rounding. If a worker dies, others do its
        views.
    note : dict, optional
        Further entries of metrics.json in the folder.
    options
        Any option of the method by its flat name, such as iterations=800, n_points=20_000 or lambda_tv=0.1.

    Returns
    -------
    Fit

    Raises
    ------
    InputError
        For an unknown method or option, a scan without signal or larger than memory, a folder that is in use or cannot be
        written, a checkpoint of another fit, a fit that diverges, and a cluster that does not answer or cannot do this fit.
    KeyboardInterrupt
        Between two steps after Ctrl-C; with a folder, its checkpoint is written.

    Examples
    --------
    `fit = lm.fit(data, lm.LINGO(), folder='out/foot')`
    """
    variant = ensure_variant()
    require_type('scan', scan, (Scan, Dataset))
    require_type('method', method, (str, Method))
    require_type('live', live, bool)
    seed, unit = parsing.seed(seed), unit_of(units, mu_water)
    dataset = with_held_out(scan, hold_out)
    if dataset.volume is None:  # else it is simulated, as a rule
        warn_of_intensities(dataset.train)
    chosen = method.changed(**options) if isinstance(method, Method) else method_of(method, **options)
    if cluster is not None:
        chosen.require_batch()
    if resume and folder is None:
        raise InputError('resume=True needs the folder of the checkpoint to go on from: give folder=FOLDER')
    path = None if folder is None else result_folder(as_path('folder', folder), force=force, resume=resume)
    check_memory(dataset.train.geometry)
    label = title or (chosen.name if path is None else path.name)
    with nullcontext() if path is None else locked(path):
        if path is not None:
            clear_leftovers(path)
            require_ours(path, result_names(chosen, 0 if dataset.test is None else len(dataset.test)))
        checkpoint = None if path is None else path / CHECKPOINT
        watchers, few = watchers_of(dataset.train.geometry, live, log_dir, label), few_views(dataset)
        with (
            nullcontext() if cluster is None else opened(cluster, None, variant=variant, bar=False) as workers,
            _reporting(chosen.iterations, progress) as report,
            watched(watchers, chosen.iterations) as watch,
            between_steps() as check,
        ):

            def between(iteration: int, **fields: Any) -> None:
                report(iteration, **fields)
                watch.step(iteration, **fields)
                check()

            def measure(fit: Fit) -> dict:
                fit = fit.with_data(few)
                numbers = quick_measure(fit)
                watch.snapshot(fit, numbers)
                return numbers

            result = run(
                dataset.train,
                chosen,
                seed,
                measure=measure,
                progress=between,
                path=checkpoint,
                resume=resume,
                cluster=workers,
            )
        result = result.with_data(dataset)
        if path is not None:
            if dataset.test is not None and (not isinstance(scan, Dataset) or scan.test is None):
                whole = len(dataset.train) + len(dataset.test)
                note = dict(held_out=f'{len(dataset.test)} of {whole}, evenly spaced') | (note or {})
            result.write(path, label, note, unit)
    return result


@contextmanager
def _reporting(total: int, progress: bool | Callable[..., None]) -> Iterator[Callable[..., None]]:
    if callable(progress):
        yield progress
        return
    with Progress('Fit', total, shown=progress) as bar:
        yield bar.update
