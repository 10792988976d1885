"""The end of a fit: a first fit, to part of the views, finds the step after which it predicts the other views no better.

A fit of noisy projections is at its best before it agrees with them: later steps turn noise into structure, and undetermined
parts of the volume into streaks. The fitted views do not show this, and neither do single pixels or rows that are held out of
them: their predictions improve long after the volume has become worse. Whole views that are held out show it, weighted as in
`lingo_mi.reconstruction.held_out`.

So there are two fits, each from its start. The first, the search, sees all views but some, and ends once these are predicted no
better. The second sees all views, and ends at the step that was best in the search, with the rates of a fit that would not end
there. Its steps are the same as without a search. After Golub, Heath and Wahba, Technometrics 21, 1979.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.measured import trusted
from lingo_mi.fitting.method import Method, Stepper
from lingo_mi.reconstruction.held_out import power, split_views
from lingo_mi.scan import Scan

HELD_OUT = 5  # one view in so many


class HeldOut:
    """Judges the states of a fit by views that it does not see.

    Attributes
    ----------
    seen : Scan
        The views that the search fits.
    record : dict
        `iterations`, steps done at every judgement; `errors`, |A x - b| / |b| of the held-out views, weighted by the root of the
        frequency; `best`, steps done at the least error.
    """

    def __init__(self, scan: Scan, method: Method, record: dict | None = None):
        """record: of the search so far. Raises InputError for fewer than four views."""
        self.seen, self.views = split_views(trusted(scan, method.effects), HELD_OUT)
        self.record: dict[str, Any] = record or dict(best=0, iterations=[], errors=[])
        self._every, self._patience = method.stopping.stop_every, method.stopping.stop_patience
        self._last = method.iterations
        self._norm = power(self.views.projections).mean() or 1.0

    def due(self, iteration: int) -> bool:
        """Return whether to judge after so many steps."""
        return iteration % self._every == 0 or iteration == self._last

    def judge(self, iteration: int, stepper: Stepper, state: DeviceState) -> None:
        """Add the error of a state to the record."""
        wrong = stepper.model.expected(state, stepper.between(self.views.geometry)) - self.views.projections
        if self.views.valid is not None:
            wrong[~self.views.valid] = 0
        record, error = self.record, float(np.sqrt(power(wrong).mean() / self._norm))
        if error < min(record['errors'], default=np.inf):
            record['best'] = iteration
        record['iterations'].append(iteration)
        record['errors'].append(error)

    @property
    def over(self) -> bool:
        """True if the search has seen enough."""
        steps = self.record['iterations']
        return bool(steps) and (steps[-1] == self._last or steps[-1] - self.record['best'] >= self._patience)


def sentence(record: dict) -> str:
    """Describe the decision of a search."""
    best, last = record['best'], record['iterations'][-1]
    if best == last:
        return f'took all {best} steps: the held-out error fell to the end'
    return f'stopped at step {best}: held-out error did not fall for {last - best} more steps'
