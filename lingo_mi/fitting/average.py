"""Running mean of a fit's parameters: averages out the jitter of steps on single views."""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi

from lingo_mi.fitting.device_state import DeviceState, download, upload

PREFIX = 'average.'  # of its names in a checkpoint


class Average:
    """Exponential moving average of a state's raw parameters. It restarts when Gaussians are added or removed.

    After Polyak and Juditsky, "Acceleration of stochastic approximation by averaging", SIAM J. Control Optim. 30 (1992), who
    average all steps.

    Parameters
    ----------
    decay : float
        Weight of the previous mean in the next one; 0: no averaging.
    """

    def __init__(self, decay: float):
        self.decay, self.values = decay, None

    def add(self, state: DeviceState) -> None:
        """Add a step's parameters to the mean."""
        if self.decay == 0:
            return
        if self.values is None:
            self.values = dict(state.values)
        keep = dr.opaque(mi.Float, self.decay)
        self.values = {k: keep * self.values[k] + (1 - keep) * dr.detach(v) for k, v in state.values.items()}
        dr.eval(self.values)

    def restart(self) -> None:
        """Discard the mean."""
        self.values = None

    def of(self, state: DeviceState) -> DeviceState:
        """The state of now, which later steps do not change, with its parameters replaced by their mean."""
        out = copy.copy(state)
        out.values = dict(state.values if self.values is None else self.values)  # steps replace its arrays
        return out

    def arrays(self) -> dict:
        """The mean by name, float32 [N, components], for a checkpoint."""
        return {PREFIX + k: v for k, v in download(self.values or {}).items()}

    def restore(self, arrays: dict) -> None:
        """Restore the output of `arrays`."""
        self.values = upload(values_of(arrays)) or None


def values_of(arrays: dict) -> dict:
    """The mean from a checkpoint's arrays, by parameter name, float32 [N, components]; empty if there is none."""
    return {k.removeprefix(PREFIX): v for k, v in arrays.items() if k.startswith(PREFIX)}
