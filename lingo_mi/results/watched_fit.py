"""A fit from its first step or from a checkpoint to the last step, with those who look at it, and Ctrl-C between two steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from lingo_mi.common.interrupts import between_steps
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.settings import Settings
from lingo_mi.results.measure import quick_measure
from lingo_mi.results.watch import Watcher, watched
from lingo_mi.scan import Dataset


def watched_fit(
    dataset: Dataset,
    settings: Settings,
    seed: int,
    progress: Callable[..., None],
    watchers: Sequence[Watcher],
    checkpoint: Path,
    resume: bool,
) -> Fitted:
    """Fit a scan.

    progress     called between steps, as of `fitting.loop.run`. After its KeyboardInterrupt, or Ctrl-C, `resume` goes on
    checkpoint   the file that is written on the way and at the end
    resume       from the checkpoint

    Raises InputError where the fit does not work out.
    """
    cloud = None if resume else initial_cloud(dataset.train, settings, seed)
    with watched(watchers, settings.iterations) as watch, between_steps() as check:

        def report(iteration, **fields):
            progress(iteration, **fields)
            watch.step(iteration, **fields)
            check()

        look = quick_measure(dataset, look=watch.look if watchers else None)
        return run(dataset.train, settings, cloud, seed, look, report, checkpoint)
