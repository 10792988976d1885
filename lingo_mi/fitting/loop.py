"""The loop of a fit: views in turn, densification, measurements on the way, checkpoints."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import drjit_lock
from lingo_mi.fitting.average import Average
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.resume import identity, require_same_fit
from lingo_mi.fitting.stopping import HeldOut
from lingo_mi.fitting.view_order import view_order
from lingo_mi.jobs.cluster import Cluster
from lingo_mi.scan import Scan

Measure = Callable[[Fit], dict]
Report = Callable[..., None]


@drjit_lock()
def run(
    scan: Scan,
    method: Method,
    seed: int = 0,
    *,
    measure: Measure | None = None,
    progress: Report | None = None,
    path: Path | None = None,
    resume: bool = False,
    at: Iterable[int] | None = None,
    cluster: Cluster | None = None,
) -> Fit:
    """Fit a scan.

    Parameters
    ----------
    scan : Scan
        The views to fit.
    method : Method
        How.
    seed : int
        Seed of all random choices.
    measure : callable, optional
        Called as measure(fit) at a few iterations; returns numbers for the history. Not in a search for the step to stop at.
    progress : callable, optional
        Called as progress(iterations done, loss=, gaussians=, **last measurement) between steps; gaussians is None for a neural
        field. In a search held_out= is its error so far; after it stops_at= is its result. If progress raises KeyboardInterrupt,
        a checkpoint is written.
    path : Path, optional
        Checkpoint file, written every `checkpoint_seconds` and at the end; its folder is created.
    resume : bool
        Go on from the file `path`, with the same steps as without the interruption. The fit may then have more iterations than
        the checkpoint's, if the method is `extensible`.
    at : iterable of int, optional
        Iterations to measure at, besides the last (default: `measure_at`).
    cluster : Cluster, optional
        Workers that do the views of each step.

    Raises
    ------
    InputError
        For a scan that cannot be fitted, a checkpoint of another fit, a fit that diverges, and one that workers cannot do.

    Examples
    --------
    `run(scan, Fast()).volume()`
    """
    wanted, method, stored = method, method.bounded(scan), None
    if resume:
        if path is None:
            raise InputError('a fit that goes on needs the path of its checkpoint')
        require_same_fit(stored := Checkpoint.load(path), method, scan, seed, path)
    last, search = method.iterations, None  # `search` is a record
    if method.stopping.stop == 'on':
        if stored is None or stored.searching:
            search, stored = _search(scan, method, wanted, seed, progress, path, stored, cluster), None
        else:
            search = stored.search or {}
        last = int(search['best'])
    fit = Running(scan, scan, method, seed, stored, search, cluster=cluster)
    marks = {*(measure_at(method.iterations) if at is None else at), last}

    def after() -> dict:
        if fit.iteration in marks:
            fit.measure(measure)
        return fit.latest | ({} if search is None else dict(stops_at=last))

    _loop(fit, lambda: fit.iteration >= last, after, progress, path)
    return fit.end(path)


def _search(
    scan: Scan,
    method: Method,
    wanted: Method,
    seed: int,
    progress: Report | None,
    path: Path | None,
    stored: Checkpoint | None,
    cluster: Cluster | None,
) -> dict:
    """The record of the search for the step to stop at: the loop on part of the views, until it predicts the others no better.

    Parameters
    ----------
    wanted : Method
        The method without the limits that the whole scan sets.
    """
    judge = HeldOut(scan, method, None if stored is None else stored.search)
    seen = judge.seen
    batch, stopping = min(wanted.batch, len(seen)), replace(wanted.stopping, stop='off')
    search_method = replace(wanted, batch=batch, stopping=stopping).bounded(seen)
    fit = Running(scan, seen, method, seed, stored, judge.record, search_method, cluster)

    def after() -> dict:
        if judge.due(fit.iteration):
            judge.judge(fit.iteration, fit.stepper, fit.average.of(fit.state))
        return dict(held_out=judge.record['errors'][-1] if judge.record['errors'] else float('nan'))

    _loop(fit, lambda: judge.over, after, progress, path)
    return judge.record


def _loop(
    fit: Running, over: Callable[[], bool], after: Callable[[], dict], progress: Report | None, path: Path | None
) -> None:
    """Steps until it is over, with progress and checkpoints between them. after() returns what progress shows."""
    saved = time.perf_counter()
    while not over():
        fit.step()
        shown = after()
        if progress is not None:
            try:
                count = len(fit.state) or None
                progress(fit.iteration, loss=lambda: fit.loss, gaussians=count, **shown)
            except KeyboardInterrupt:
                fit.save(path)
                raise
        if time.perf_counter() - saved > fit.method.checkpoint_seconds:
            fit.save(path)
            saved = time.perf_counter()


class Running:
    """A fit that runs, from its start or from a checkpoint.

    Attributes
    ----------
    method : Method
        Method of the whole fit, with the limits that the scan sets.
    stepper : Stepper
        The optimisation on the views that it sees.
    state : DeviceState
        After the last step.
    average : Average
        Average of the states.
    rng : Generator
        Generator of the views' order, the total variation's cubes and the splits.
    order : list of int
        Views that are next.
    iteration : int
        Steps done.
    history : list of dict
        Measurements over time.
    """

    def __init__(
        self,
        scan: Scan,
        seen: Scan,
        method: Method,
        seed: int,
        stored: Checkpoint | None,
        search: dict | None,
        method_seen: Method | None = None,
        cluster: Cluster | None = None,
    ):
        """seen: the views of the scan that the steps see; method_seen: the method for these views, if it differs; search: a
        record; cluster: its workers do the views."""
        self.geometry, self.identity, self.seen = scan.geometry, identity(scan), len(seen)
        self.method, self.seed, self.search = method, seed, search
        self.rng, self.average = np.random.default_rng(seed), Average(method.rates.average)
        method_seen = method_seen or method
        self.stepper = method_seen.stepper(seen)
        if cluster is not None:
            self.stepper.divide(cluster, method_seen)
        self.order: list[int] = []
        self.iteration, self.history, self._seconds = 0, [], 0.0
        self._losses = deque(maxlen=-(-len(seen) // self.stepper.method.batch))  # of the last pass over the views
        if stored is None:
            state, self.points, self.info = self.stepper.begin(seed)
            self.state = DeviceState(state)
        else:
            self.state = DeviceState(stored.state)
            self.rng.bit_generator.state = stored.rng
            self.points, self.order = stored.arrays['initial'], [int(i) for i in stored.arrays['order']]
            self.iteration, self._seconds, self.info = stored.iteration, stored.seconds, stored.info
            self.history = stored.history
            self._losses.extend(mi.Float(float(loss)) for loss in stored.arrays['losses'])
            self.stepper.restore(stored.arrays)
            self.average.restore(stored.arrays)
        self._clock = time.perf_counter()

    def step(self) -> None:
        """Densify if it is due, and make a step."""
        # Before a step, so never after the last one. A longer fit that goes on from there does it first.
        if densified := self.stepper.densified(self.state, self.iteration, self.rng):
            self.state = densified
            self.average.restart()
        batch = self.stepper.method.batch
        while len(self.order) < batch:  # every view once before any view twice
            self.order += view_order(self.stepper.geometry, self.method.view_order, self.rng)
        views, self.order = self.order[:batch], self.order[batch:]
        loss = self.stepper.step(self.state, views, self.iteration, self.rng)
        self.iteration += 1
        dr.eval(loss)  # else it would hold the images of its views
        self._losses.append(loss)
        self.average.add(self.state)

    @property
    def loss(self) -> float:
        """The mean over the last pass, since single views differ."""
        return float(np.mean([loss[0] for loss in self._losses]))

    def measure(self, measure: Measure | None) -> None:
        """Add an entry to the history; the time of `measure` does not count.

        Raises
        ------
        InputError
            If the fit has diverged.
        """
        dr.sync_thread()
        value = self.loss
        if not (np.isfinite(value) and self.state.finite()):  # a Gaussian that is not finite would silently vanish
            raise InputError(
                f'the fit is no longer finite at iteration {self.iteration}: lower the rates, or check the projections'
            )
        self._seconds = self.seconds
        entry = dict(iteration=self.iteration, seconds=self._seconds, loss=value, gaussians=len(self.state))
        self.history.append(entry | (measure(self.fit()) if measure else {}))
        self._clock = time.perf_counter()

    @property
    def latest(self) -> dict:
        """The last measured qualities, for the progress line."""
        last = self.history[-1].items() if self.history else ()
        return {k: v for k, v in last if k.startswith('psnr') and not k.endswith('_r2')}

    @property
    def seconds(self) -> float:
        """Spent in steps, including those before an interruption."""
        return self._seconds + time.perf_counter() - self._clock

    def checkpoint(self, state: DeviceState | None = None) -> Checkpoint:
        """The fit as it is; with a state, of that state."""
        model, losses = self.stepper.model, np.array([loss[0] for loss in self._losses])
        arrays = dict(initial=self.points, order=np.array(self.order, int), losses=losses)
        return Checkpoint(
            method=self.method,
            geometry=self.geometry,
            unit=model.unit,
            state=(state or self.state).host(),
            arrays=arrays | self.stepper.arrays() | self.average.arrays(),
            seed=self.seed,
            rng=dict(self.rng.bit_generator.state),
            iteration=self.iteration,
            seconds=self.seconds,
            history=self.history,
            info=self.info,
            scan=self.identity,
            effects=model.effects is not None,
            search=self.search,
            seen=self.seen,
        )

    def fit(self) -> Fit:
        """The result as it is: the mean of the last states."""
        return Fit(self.checkpoint(self.average.of(self.state)), self.stepper.model)

    def save(self, path: Path | None) -> None:
        """Write a checkpoint, from which a fit goes on with the same steps; None: nowhere. Its folder is created."""
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.checkpoint().save(path)

    def end(self, path: Path | None) -> Fit:
        """The result, which is the last checkpoint."""
        self.state = self.average.of(self.state)
        dr.sync_thread()
        self.save(path)
        return self.fit()


def measure_at(iterations: int) -> list[int]:
    """Iterations to measure at: a hundredth as many, but four to twelve, denser at the start, including the last."""
    count = min(max(iterations // 100, 4), 12)
    return sorted({max(1, round(iterations * share**1.5)) for share in np.linspace(0, 1, count + 1)[1:]})
