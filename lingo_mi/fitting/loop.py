"""The loop of a fit: views in turn, densification, intermediate measurements, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import drjit as dr
import numpy as np

from lingo_mi.errors import InputError
from lingo_mi.fitting import checkpoint
from lingo_mi.fitting.average import Average
from lingo_mi.fitting.bounded import bounded
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.kinds import Model, stepper_of
from lingo_mi.fitting.measured import modelled_effects
from lingo_mi.fitting.resume import moments, require_same_fit, traits
from lingo_mi.fitting.settings import Settings
from lingo_mi.fitting.stopping import Search
from lingo_mi.fitting.view_order import view_order
from lingo_mi.lingo.initialise import InitialCloud
from lingo_mi.metrics import current_names
from lingo_mi.runtime import one_at_a_time
from lingo_mi.scan import Scan
from lingo_mi.scene.description import describe


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
    given, settings = settings, bounded(settings, scan)
    search = Search(scan, given) if settings.stopping.stop == 'on' else None
    rng = np.random.default_rng(seed)
    average = Average(settings.adam.average)
    scanned = dict(
        views=len(scan),
        scanner=describe(scan.geometry),
        signal=float(scan.projections.mean(dtype=float)),
        moments=moments(scan.projections),
        traits=traits(scan),
    )
    if isinstance(begin, Path):
        host, extra, arrays = checkpoint.load(begin)
        modelled = modelled_effects(scan, settings)
        require_same_fit(extra, settings, scanned, seed, begin, bool(modelled and modelled.scatter))
        rng.bit_generator.state = extra['rng']
        points, order = arrays['initial'], [int(i) for i in arrays['order']]
        iteration, seconds, info = (extra[k] for k in ('iteration', 'seconds', 'info'))
        history = [current_names(entry) for entry in extra['history']]
        state = DeviceState(host)
        if search is not None:
            search.restore(arrays)
        stepper = search.stepper() if search and search.on else stepper_of(scan, settings)
        stepper.restore(arrays)
        average.restore(arrays)
    else:
        points, order = begin.points.astype(np.float32), []
        iteration, seconds, history, info = 0, 0.0, [], dict(begin.info)
        stepper = stepper_of(scan, settings)
        host = stepper.start(begin, rng.spawn(1)[0])  # takes nothing from the steps, which may begin anew
        if search is not None:
            stepper, host = search.begin(host, seed)
        state = DeviceState(host)
    last = search.kept if search and not search.on else settings.iterations
    marks = {*(measure_at(settings.iterations) if at is None else at), last}
    clock = saved = time.perf_counter()

    def store():
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.save(
                path,
                state.host(),
                dict(
                    seed=seed,
                    rng=rng.bit_generator.state,
                    iteration=iteration,
                    seconds=seconds + time.perf_counter() - clock,
                    history=history,
                    info=info,
                    settings=settings.flat(),
                    unit=stepper.model.unit,
                    effects=stepper.model.effects is not None,
                    **scanned,
                ),
                dict(initial=points, order=np.array(order, int))
                | stepper.arrays()
                | average.arrays()
                | (search.arrays() if search else {}),
            )

    while iteration < last or search and search.on:
        if search and search.on and search.over:  # begin anew, with all views
            stepper, state = stepper_of(scan, settings), DeviceState(search.end())
            rng, order, iteration, last = np.random.default_rng(seed), [], 0, search.kept
            marks.add(last)
            average.restart()
        # Before a step, so never after the last one. A longer fit that continues from there does it first.
        if renewed := stepper.renewed(state, iteration, rng):
            state = renewed
            average.restart()
        batch = stepper.settings.batch
        while len(order) < batch:  # every view once before any view twice
            order += view_order(stepper.geometry, settings.view_order, rng)
        views, rest = order[:batch], order[batch:]
        loss = stepper.step(state, views, iteration, rng)
        order, iteration = rest, iteration + 1
        average.add(state)
        if search and search.on:
            if search.due(iteration):
                search.look(iteration, stepper, average.of(state))
        elif iteration in marks:
            dr.sync_thread()
            value = float(loss[0])
            if not (np.isfinite(value) and state.finite()):  # a Gaussian that is not finite would silently vanish
                raise InputError(
                    f'the fit is no longer finite at iteration {iteration}: lower the rates, or check the projections'
                )
            seconds += time.perf_counter() - clock
            entry = dict(iteration=iteration, seconds=seconds, loss=value, gaussians=len(state))
            history.append(entry | (measure(stepper.model, average.of(state)) if measure else {}))
            clock = time.perf_counter()  # excludes the time of `measure`
        if progress is not None:
            measured = history[-1].items() if history else ()
            shown = {k: v for k, v in measured if k.startswith('psnr') and not k.endswith('_r2')}
            shown |= search.shown if search else {}
            try:
                progress(iteration, loss=lambda: float(loss[0]), gaussians=len(state) or None, **shown)
            except KeyboardInterrupt:
                store()
                raise
        if time.perf_counter() - saved > settings.checkpoint_seconds:
            store()
            saved = time.perf_counter()
    state = average.of(state)
    dr.sync_thread()
    store()
    seconds += time.perf_counter() - clock
    found = search.record() if search else None
    return Fitted(stepper.model, state.host(), points, stepper.poses, seed, history, seconds, info, found, iteration)


def measure_at(iterations: int) -> list[int]:
    """Iterations to measure at: one in a hundred, but four to twelve, denser at the start, including the last."""
    count = min(max(iterations // 100, 4), 12)
    return sorted({max(1, round(iterations * share**1.5)) for share in np.linspace(0, 1, count + 1)[1:]})
