"""Adam, with a learning rate a parameter (Kingma and Ba, "Adam: a method for stochastic optimization", 2015), with Nesterov's
momentum if asked for (Dozat, "Incorporating Nesterov momentum into Adam", 2016)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.method import Method


def adam_step(state: DeviceState, gradients: dict[str, Any], method: Method, iteration: int) -> None:
    """Move the parameters of `state` that have gradients, and their moments.

    Parameters
    ----------
    gradients : dict[str, Any]
        Gradients of the loss, by parameter.
    iteration : int
        Counts from 0.
    """
    b1, b2, step = method.rates.beta1, method.rates.beta2, iteration + 1
    # The first moment without its bias, now or as expected after the next step.
    of_m, of_g = 1 / (1 - b1**step), 0.0
    if method.rates.nesterov:
        of_m, of_g = b1 / (1 - b1 ** (step + 1)), (1 - b1) / (1 - b1**step)
    # Numbers that change from step to step must be opaque: as literals they would cause a new kernel every time.
    c1, cg, c2 = (dr.opaque(mi.Float, c) for c in (of_m, of_g, 1 / (1 - b2**step)))
    for name, g in gradients.items():
        m = b1 * state.first[name] + (1 - b1) * g
        v = b2 * state.second[name] + (1 - b2) * g * g
        rate = dr.opaque(mi.Float, method.rate(name, iteration))
        state.values[name] = dr.detach(state.values[name]) - rate * (m * c1 + g * cg) / (
            dr.sqrt(v * c2) + method.rates.epsilon
        )
        state.first[name], state.second[name] = m, v
    dr.eval(state.values, state.first, state.second, state.gradient, state.visits)
