"""Options of the end of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lingo_mi.fitting.options.part import MOST_STEPS, Part, require


@dataclass(frozen=True)
class Stopping(Part):
    """Options of the end of a fit; see `lingo_mi.fitting.stopping`.

    Parameters
    ----------
    stop : {'off', 'on', 'auto'}
        'off': after `iterations`. 'on': a first fit finds the step after which it predicts held-out views no better, and
        a second fit of all views ends there. 'auto': 'on' if
        the scan says how many photons a pixel counts, else 'off'.
    stop_every : int
        Iterations between two predictions of the held-out views.
    stop_patience : int
        Iterations without a better prediction after which the first fit ends, at least `stop_every`.

    Examples
    --------
    `lm.fit(scan, lm.Fast().changed(stop='on'))`
    """

    RANGES: ClassVar = dict(stop_every=(1, MOST_STEPS), stop_patience=(1, MOST_STEPS))
    CHOICES: ClassVar = dict(stop=('off', 'on', 'auto'))

    stop: str = 'off'
    stop_every: int = 50
    stop_patience: int = 150

    def __post_init__(self):
        super().__post_init__()
        require(
            self.stop_patience >= self.stop_every,
            f'stop_patience must be at least stop_every, {self.stop_every}, not {self.stop_patience}',
        )
