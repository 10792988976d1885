"""A fit that runs: what it keeps from step to step, and in a checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from lingo_mi.common.errors import InputError
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
from lingo_mi.metrics.quality import current_names
from lingo_mi.scan import Scan
from lingo_mi.scene.description import describe


class Running:
    """A fit that runs, from an initial cloud or from the checkpoint at a path. Raises InputError for that of another fit.

    settings     as used, with the bounds that the scan sets
    search       for the step to stop at; None: the fit makes all steps
    stepper      the optimisation: of the views that the search sees while it is on, then of all views
    state        after the last step
    average      of the states
    rng          of the views' order, the total variation's cubes and splits
    order        views that are next
    iteration    steps done; during a search, of the search
    last         steps to do
    history      measurements over time
    seconds      spent in steps up to the time `clock`
    scanned      what a checkpoint says of the scan
    points, info   centres that the fit started from, and data on them
    """

    def __init__(self, scan: Scan, settings: Settings, seed: int, begin: InitialCloud | Path):
        self.scan, self.settings, self.seed = scan, bounded(settings, scan), seed
        self.search = Search(scan, settings) if self.settings.stopping.stop == 'on' else None
        self.rng = np.random.default_rng(seed)
        self.order: list[int] = []
        self.average = Average(self.settings.adam.average)
        self.iteration, self.last = 0, self.settings.iterations
        self.history: list[dict] = []
        self.seconds = 0.0
        self.scanned = dict(
            views=len(scan),
            scanner=describe(scan.geometry),
            signal=float(scan.projections.mean(dtype=float)),
            moments=moments(scan.projections),
            traits=traits(scan),
        )
        if isinstance(begin, Path):
            self._resume(begin)
        else:
            self._start(begin)
        self.clock = time.perf_counter()

    def _start(self, initial):
        self.points, self.info = initial.points.astype(np.float32), dict(initial.info)
        self.stepper = stepper_of(self.scan, self.settings)
        # A generator of its own takes nothing from the steps, which may begin anew.
        state = self.stepper.start(initial, self.rng.spawn(1)[0])
        if self.search is not None:
            self.stepper, state = self.search.begin(state, self.seed)
        self.state = DeviceState(state)

    def _resume(self, path):
        state, extra, arrays = checkpoint.load(path)
        modelled = modelled_effects(self.scan, self.settings)
        require_same_fit(extra, self.settings, self.scanned, self.seed, path, bool(modelled and modelled.scatter))
        self.rng.bit_generator.state = extra['rng']
        self.points, self.order = arrays['initial'], [int(i) for i in arrays['order']]
        self.iteration, self.seconds, self.info = (extra[k] for k in ('iteration', 'seconds', 'info'))
        self.history = [current_names(entry) for entry in extra['history']]
        self.state = DeviceState(state)
        search = self.search
        if search is not None:
            search.restore(arrays)
            self.last = self.last if search.on else search.kept
        self.stepper = search.stepper() if search and search.on else stepper_of(self.scan, self.settings)
        self.stepper.restore(arrays)
        self.average.restore(arrays)

    @property
    def over(self) -> bool:
        """Whether all steps are done."""
        return not (self.search and self.search.on) and self.iteration >= self.last

    def step(self) -> Any:
        """Densify if it is due, and make a step. Returns the loss, Float [1], not yet evaluated."""
        if self.search and self.search.on and self.search.over:  # begin anew with all views, for as long as was best
            self.stepper, self.state = stepper_of(self.scan, self.settings), DeviceState(self.search.end())
            self.rng, self.order = np.random.default_rng(self.seed), []
            self.iteration, self.last = 0, self.search.kept
            self.average.restart()
        # Before a step, so never after the last one. A longer fit that continues from there does it first.
        if renewed := self.stepper.renewed(self.state, self.iteration, self.rng):
            self.state = renewed
            self.average.restart()
        batch = self.stepper.settings.batch
        while len(self.order) < batch:  # every view once before any view twice
            self.order += view_order(self.stepper.geometry, self.settings.view_order, self.rng)
        views, self.order = self.order[:batch], self.order[batch:]
        loss = self.stepper.step(self.state, views, self.iteration, self.rng)
        self.iteration += 1
        self.average.add(self.state)
        return loss

    def look(self, loss: Any, marks: set[int], measure: Callable[[Model, DeviceState], dict] | None) -> None:
        """After a step: let the search judge the state, if it is due; after a search, measure it, at the marks and at the end.

        Raises InputError if the fit has diverged.
        """
        if self.search and self.search.on:
            if self.search.due(self.iteration):
                self.search.look(self.iteration, self.stepper, self.average.of(self.state))
        elif self.iteration in marks or self.iteration == self.last:
            self._measure(loss, measure)

    def _measure(self, loss, measure):
        """Add an entry to the history; the time of `measure` does not count."""
        dr.sync_thread()
        value = float(loss[0])
        if not (np.isfinite(value) and self.state.finite()):  # a Gaussian that is not finite would silently vanish
            raise InputError(
                f'the fit is no longer finite at iteration {self.iteration}: lower the rates, or check the projections'
            )
        self.seconds = self._seconds()
        entry = dict(iteration=self.iteration, seconds=self.seconds, loss=value, gaussians=len(self.state))
        self.history.append(entry | (measure(self.stepper.model, self.average.of(self.state)) if measure else {}))
        self.clock = time.perf_counter()

    @property
    def shown(self) -> dict:
        """What is told of the state between steps: the last measured qualities, and what the search says."""
        measured = self.history[-1].items() if self.history else ()
        shown = {k: v for k, v in measured if k.startswith('psnr') and not k.endswith('_r2')}
        return dict(gaussians=len(self.state) or None) | shown | (self.search.shown if self.search else {})

    def store(self, path: Path | None) -> None:
        """Write a checkpoint, from which a fit goes on with the same steps; None: nowhere. Its folder is created."""
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        model = self.stepper.model
        extra = dict(
            seed=self.seed,
            rng=self.rng.bit_generator.state,
            iteration=self.iteration,
            seconds=self._seconds(),
            history=self.history,
            info=self.info,
            settings=self.settings.flat(),
            unit=model.unit,
            effects=model.effects is not None,
            **self.scanned,
        )
        arrays = dict(initial=self.points, order=np.array(self.order, int))
        arrays |= self.stepper.arrays() | self.average.arrays() | (self.search.arrays() if self.search else {})
        checkpoint.save(path, self.state.host(), extra, arrays)

    def end(self, path: Path | None) -> Fitted:
        """The result: the mean of the last states. It is the last checkpoint."""
        self.state = self.average.of(self.state)
        dr.sync_thread()
        self.store(path)
        return Fitted(
            self.stepper.model,
            self.state.host(),
            self.points,
            self.stepper.poses,
            self.seed,
            self.history,
            self._seconds(),
            self.info,
            self.search.record() if self.search else None,
            self.iteration,
        )

    def _seconds(self):
        """Spent in steps, including those before an interruption."""
        return self.seconds + time.perf_counter() - self.clock
