"""The loop of a fit: views in turn, densification, intermediate measurements, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import one_at_a_time
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.kinds import Model
from lingo_mi.fitting.running import Running
from lingo_mi.fitting.settings import Settings
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.scan import Scan


@one_at_a_time()
def run(
    scan: Scan,
    settings: Settings,
    initial: InitialCloud | None,
    seed: int = 0,
    measure: Callable[[Model, DeviceState], dict] | None = None,
    progress: Callable[..., None] | None = None,
    path: Path | None = None,
    at: Iterable[int] | None = None,
) -> Fitted:
    """Fit a cloud, or a neural field, to a scan.

    scan       the views to fit
    initial    the initial cloud; None: continue from `path`, with the same steps as without the interruption. The fit may
               then have more iterations than the checkpoint's, if it is `resume.extensible`
    seed       for the views' order, the total variation's cubes and splits; of a neural field, parameters, rays and samples
    measure    called as measure(model, state) at a few iterations; returns numbers for the history. Not while the fit searches
               for the step to stop at (setting `stop`)
    progress   called as progress(iterations done, loss=, gaussians=, **last measurement) between steps; gaussians is None for
               a neural field; during a search held_out= is its error so far. The state is then consistent: if it raises
               KeyboardInterrupt, a checkpoint is written
    path       checkpoint file, written every `checkpoint_seconds` and at the end; its folder is created
    at         iterations to measure at, besides the last; None: `measure_at`

    Raises InputError for a scan that cannot be fitted, a checkpoint of another fit, and a fit that diverges.

    Example: `run(scan, FAST, initial_cloud(scan, FAST)).volume()`.
    """
    begin = path if initial is None else initial
    if begin is None:
        raise InputError('a fit needs an initial cloud to start from, or the path of a checkpoint to go on from')
    fit = Running(scan, settings, seed, begin)
    marks = set(measure_at(fit.settings.iterations) if at is None else at)
    saved = time.perf_counter()
    while not fit.over:
        loss = fit.step()
        fit.look(loss, marks, measure)
        if progress is not None:
            try:
                progress(fit.iteration, loss=lambda value=loss: float(value[0]), **fit.shown)
            except KeyboardInterrupt:
                fit.store(path)
                raise
        if time.perf_counter() - saved > fit.settings.checkpoint_seconds:
            fit.store(path)
            saved = time.perf_counter()
    return fit.end(path)


def measure_at(iterations: int) -> list[int]:
    """Iterations to measure at: a hundredth as many, but four to twelve, denser at the start, including the last."""
    count = min(max(iterations // 100, 4), 12)
    return sorted({max(1, round(iterations * share**1.5)) for share in np.linspace(0, 1, count + 1)[1:]})
