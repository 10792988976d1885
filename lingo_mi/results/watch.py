"""Watchers of a fit: they are told of its steps and shown its state, cost little, and never stop it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from lingo_mi.common.errors import brief
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.kinds import Model
from lingo_mi.scan import Scan

EVERY = 1.0  # seconds between two steps that watchers are told of


@dataclass(eq=False)
class Snapshot:
    """A fit at one of the moments at which it is measured. What was not measured is computed when it is asked for.

    test       held-out views (some), or None
    views      the same, rendered, float32 [view, v, u]
    measured   the volume, float32 [x, y, z], where it has a truth to be compared with, and that truth
    numbers    what was measured, by name
    """

    model: Model
    state: DeviceState
    test: Scan | None
    views: np.ndarray | None
    measured: tuple[np.ndarray, np.ndarray] | None
    numbers: dict

    @cached_property
    def volume(self) -> np.ndarray | None:
        """Density per mm; None for alpha compositing."""
        return self.measured[0] if self.measured else self.model.volume(self.state)

    @cached_property
    def gaussians(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `Fitted.world_gaussians`."""
        return Fitted(self.model, self.state.host(), np.empty((0, 3))).world_gaussians()


class Watcher(Protocol):
    """What looks at a fit."""

    def search(self, iteration: int, held_out: float) -> None:
        """About every second of a search for the step to stop at (`fitting.stopping`): steps done, and its error so far."""

    def step(self, entry: dict, total: int) -> None:
        """About every second: `iteration`, `seconds`, `loss`, `gaussians`, and at some also what was measured; steps in all."""

    def look(self, snapshot: Snapshot) -> None:
        """At a few moments, each right before the step that has its numbers."""

    def close(self, finished: bool) -> None:
        """At the end; finished: False where the fit was stopped."""


class Watch:
    """All watchers of a fit; one that fails is left out, with a warning."""

    def __init__(self, watchers: Iterable[Watcher], total: int):
        """total: steps of the fit."""
        self.watchers, self.total = list(watchers), total
        self._began = time.perf_counter()
        self._told, self._new = 0.0, {}

    def step(
        self,
        iteration: int,
        loss: Callable[[], float],
        gaussians: int,
        *,
        held_out: float | None = None,
        stops_at: int | None = None,
        **_: Any,
    ) -> None:
        """To be called after every step with what `fitting.loop.run` reports. It returns at once where nothing is to be told."""
        now, total = time.perf_counter() - self._began, stops_at or self.total
        if not self.watchers or not (self._new or now - self._told >= EVERY or iteration == total):
            return
        self._told = now
        if held_out is not None:
            return self._each(lambda watcher: watcher.search(iteration, held_out))
        entry = dict(iteration=iteration, seconds=now, loss=loss(), gaussians=gaussians) | self._new
        self._new = {}
        self._each(lambda watcher: watcher.step(entry, total))

    def look(self, snapshot: Snapshot) -> None:
        """To be called with a state that is measured."""
        self._new = snapshot.numbers
        self._each(lambda watcher: watcher.look(snapshot))

    def close(self, finished: bool) -> None:
        """To be called at the end."""
        self._each(lambda watcher: watcher.close(finished))

    def _each(self, tell: Callable[[Watcher], Any]) -> None:
        for watcher in [*self.watchers]:
            try:
                tell(watcher)
            except Exception as error:  # of a server, a disk: the fit is worth more than a look at it
                self.watchers.remove(watcher)
                warnings.warn(
                    f'{type(watcher).__name__} has failed ({brief(error, 150)}); the fit goes on', stacklevel=2
                )


@contextmanager
def watched(watchers: Iterable[Watcher], total: int) -> Iterator[Watch]:
    """A `Watch` whose watchers are closed at the end, whatever ends it."""
    watch, finished = Watch(watchers, total), False
    try:
        yield watch
        finished = True
    finally:
        watch.close(finished)
