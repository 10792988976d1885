"""A running mean of a fit's parameters: steps on single views jitter about what they converge to, and their mean does not."""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi

from lingo_mi.fitting.device import DeviceState, download, upload

PREFIX = 'average.'  # of the names in a checkpoint


class Average:
    """The exponential moving average of a state's raw parameters, which begins anew when Gaussians come or go.

    decay   share of the earlier mean in the next one; 0: the parameters themselves

    Polyak and Juditsky, "Acceleration of stochastic approximation by averaging", SIAM J. Control Optim. 30 (1992), who take
    the mean of all steps.
    """

    def __init__(self, decay: float):
        self.decay, self.values = decay, None

    def add(self, state: DeviceState) -> None:
        """Take a step's parameters into the mean."""
        if self.decay == 0:
            return
        if self.values is None:
            self.values = dict(state.values)
        keep = dr.opaque(mi.Float, self.decay)
        self.values = {k: keep * self.values[k] + (1 - keep) * dr.detach(v) for k, v in state.values.items()}
        dr.eval(self.values)

    def restart(self) -> None:
        """Forget the mean."""
        self.values = None

    def of(self, state: DeviceState) -> DeviceState:
        """The state with the mean in place of its parameters."""
        if self.values is None:
            return state
        out = copy.copy(state)
        out.values = self.values
        return out

    def arrays(self) -> dict:
        """The mean by name, float32 [N, components], for a checkpoint."""
        return {PREFIX + k: v for k, v in download(self.values or {}).items()}

    def restore(self, arrays: dict) -> None:
        """Take over what `arrays` gave."""
        self.values = upload(values_of(arrays)) or None


def values_of(arrays: dict) -> dict:
    """The mean in the arrays of a checkpoint, by the parameters' names, float32 [N, components]; empty where there is none."""
    return {k.removeprefix(PREFIX): v for k, v in arrays.items() if k.startswith(PREFIX)}
