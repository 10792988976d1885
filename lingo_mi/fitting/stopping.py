"""When a fit stops: a search, on part of the views, for the step from which the other views are predicted no better.

A fit of noisy projections is at its best before it has met them: later steps turn noise into structure, and what the views do not
determine into streaks. Neither shows in the views that are fitted, nor in single pixels or rows that are held out of them,
which are predicted better and better long after the volume has become worse. It shows in whole views, weighted as in
`lingo_mi.reconstruction.held_out`.

So the fit runs twice, from its start. The first time, the search, sees all views but some, and ends once these are predicted no
better. The second time sees all views, and ends at the step that was best in the search, with the rates of a fit that would not
end there. Its steps are those of a fit without a search. After Golub, Heath and Wahba, Technometrics 21, 1979.
"""

from __future__ import annotations

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.fitting.bounded import bounded
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field.field_step import FieldStepper
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.kinds import stepper_of
from lingo_mi.fitting.measured import trusted
from lingo_mi.fitting.settings import HELD_OUT, Settings
from lingo_mi.fitting.state import State
from lingo_mi.fitting.step import Stepper
from lingo_mi.reconstruction.held_out import power, split
from lingo_mi.scan import Scan

PREFIX = 'search.'  # of its names in a checkpoint


class Search:
    """The search for the step to stop at, look by look.

    seen, held_out       scans: the views that the search fits, and those that it does not see
    on                   whether it goes on; else the fit of all views has begun
    iterations, errors   of all looks: steps done; |A x - b| / |b| of the views held out, weighted by the root of the frequency
    kept                 steps done at the least error
    """

    def __init__(self, scan: Scan, settings: Settings):
        """settings: of the whole fit, before they are `bounded`. Raises InputError for fewer than four views."""
        self.seen, self.held_out = split(trusted(scan, settings), HELD_OUT)
        self.settings, self.on = settings, True
        self.all = power(self.held_out.projections).mean() or 1.0
        self.iterations: list[int] = []
        self.errors: list[float] = []
        self.kept = 0
        self.start: dict[str, np.ndarray] = {}  # parameters that the fit of all views will start from

    def stepper(self) -> Stepper | FieldStepper:
        """The optimisation on the views that it sees."""
        return stepper_of(self.seen, self._own())

    def begin(self, start: State, seed: int) -> tuple[Stepper | FieldStepper, State]:
        """The optimisation, and the state to start it from. start: that of all views, for later."""
        self.start, stepper = dict(start.values), self.stepper()
        return stepper, stepper.start(
            initial_cloud(self.seen, self._own(), seed), np.random.default_rng(seed).spawn(1)[0]
        )

    def due(self, iteration: int) -> bool:
        """Whether to look after so many steps."""
        return iteration % self.settings.stopping.stop_every == 0 or iteration == self.settings.iterations

    def look(self, iteration: int, stepper: Stepper | FieldStepper, state: DeviceState) -> None:
        """Judge a state by the views that are held out."""
        geometry = self.held_out.geometry
        if stepper.poses is not None:
            geometry = stepper.poses.between(self.seen.geometry, geometry)
        wrong = stepper.model.expected(state, geometry) - self.held_out.projections
        if self.held_out.valid is not None:
            wrong[~self.held_out.valid] = 0
        self.iterations.append(iteration)
        self.errors.append(float(np.sqrt(power(wrong).mean() / self.all)))
        if self.errors[-1] < min(self.errors[:-1], default=np.inf):
            self.kept = iteration

    @property
    def over(self) -> bool:
        """Whether enough has been seen."""
        last = self.iterations[-1] if self.iterations else 0
        return last == self.settings.iterations or last - self.kept >= self.settings.stopping.stop_patience

    def end(self) -> State:
        """The state from which the fit of all views starts."""
        self.on, values, self.start = False, self.start, {}
        zeros = {k: np.zeros_like(v) for k, v in values.items()}
        second = {k: v.copy() for k, v in zeros.items()}
        none = np.zeros(len(values['centre']) if self.settings.cloud else 0, np.float32)
        return State(values, zeros, second, none, none.copy(), none.astype(bool))

    @property
    def shown(self) -> dict:
        """What the progress line says of it."""
        if not self.on:
            return dict(stops_at=self.kept)
        return dict(held_out=self.errors[-1] if self.errors else float('nan'))

    def record(self) -> dict:
        """What it has seen and said, as plain values."""
        return record(self.iterations, self.errors, self.kept)

    def arrays(self) -> dict:
        """All it knows, by name, for a checkpoint."""
        own = dict(
            errors=np.array(self.errors),
            iterations=np.array(self.iterations, int),
            kept=np.array([self.kept]),
            views=np.array([len(self.seen)]),
            **{f'start.{k}': v for k, v in self.start.items()},
        )
        return {PREFIX + k: v for k, v in own.items()}

    def restore(self, arrays: dict) -> None:
        """Restore the output of `arrays`."""
        own = {k.removeprefix(PREFIX): v for k, v in arrays.items() if k.startswith(PREFIX)}
        self.errors, self.iterations = own['errors'].tolist(), own['iterations'].tolist()
        self.kept = int(own['kept'][0])  # an earlier program's may not be of the least error
        self.start = {k.removeprefix('start.'): v for k, v in own.items() if k.startswith('start.')}
        self.on = bool(self.start)

    def _own(self) -> Settings:
        """The settings of the search."""
        batch = min(self.settings.batch, len(self.seen))
        return bounded(self.settings.changed(stop='off', batch=batch), self.seen)


def record(iterations: list[int], errors: list[float], kept: int) -> dict:
    """What a search has seen and said, as plain values."""
    last = iterations[-1]
    if kept == last:
        said = f'took all {kept} steps: the held-out error fell to the end'
    else:
        said = f'stopped at step {kept}: held-out error did not fall for {last - kept} steps more'
    return dict(said=said, kept=kept, iterations=iterations, errors=errors)


def stored(arrays: dict) -> dict | None:
    """The `record` of a search in a checkpoint's arrays; None: the fit has not searched.

    Raises InputError while it still searches: the fit itself has not begun.
    """
    if PREFIX + 'kept' not in arrays:
        return None
    if any(name.startswith(PREFIX + 'start.') for name in arrays):
        raise InputError(
            'the fit still searches for the step to stop at, and has no result: let it go on, with --resume'
        )
    iterations, errors, kept = (arrays[PREFIX + k].tolist() for k in ('iterations', 'errors', 'kept'))
    return record(iterations, errors, kept[0])
