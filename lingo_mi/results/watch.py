"""Watchers of a fit: they receive its steps and its state, cost little, and never stop it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from lingo_mi.common.errors import brief
from lingo_mi.fitting.fit import Fit

EVERY = 1.0  # seconds between two steps that watchers are told of


class Watcher(Protocol):
    """The interface of an observer of a fit."""

    def search(self, iteration: int, held_out: float) -> None:
        """About every second of a search for the step to stop at (`fitting.stopping`): steps done, and its error so far."""

    def step(self, entry: dict, total: int) -> None:
        """About every second: `iteration`, `seconds`, `loss`, `gaussians`, and at some also what was measured; steps in all."""

    def snapshot(self, fit: Fit) -> None:
        """Called a few times, right before the step that has its numbers. The fit holds a few of its held-out views."""

    def close(self, finished: bool) -> None:
        """At the end; finished: False if the fit was stopped."""


class Watch:
    """All watchers of a fit; one that fails is left out, with a warning."""

    def __init__(self, watchers: Iterable[Watcher], total: int):
        """total: steps of the fit."""
        self.watchers, self.total = list(watchers), total
        self._began = time.perf_counter()
        self._reported, self._new = 0.0, {}

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
        """Pass on what `fitting.loop.run` reports after every step. It returns at once if nothing is due."""
        now, total = time.perf_counter() - self._began, stops_at or self.total
        if not self.watchers or not (self._new or now - self._reported >= EVERY or iteration == total):
            return
        self._reported = now
        if held_out is not None:
            return self._each(lambda watcher: watcher.search(iteration, held_out))
        entry = dict(iteration=iteration, seconds=now, loss=loss(), gaussians=gaussians) | self._new
        self._new = {}
        self._each(lambda watcher: watcher.step(entry, total))

    def snapshot(self, fit: Fit, numbers: dict) -> None:
        """Pass a measured fit, and its numbers, to all watchers."""
        self._new = dict(numbers)
        self._each(lambda watcher: watcher.snapshot(fit))

    def close(self, finished: bool) -> None:
        """Close all watchers."""
        self._each(lambda watcher: watcher.close(finished))

    def _each(self, tell: Callable[[Watcher], Any]) -> None:
        for watcher in [*self.watchers]:
            try:
                tell(watcher)
            except Exception as error:  # a server or a disk may fail: the fit is worth more than a look at it
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
