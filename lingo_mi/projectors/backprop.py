"""Backpropagation in two stages: first from the loss to copies (`leaves`), then from these to the inputs (`pass_on`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr


def leaves(values: Iterable) -> Any:
    """Detached copies that accumulate derivatives."""
    copies = tuple(dr.detach(v) for v in values)
    dr.enable_grad(copies)
    return copies


def pass_on(values: Iterable, gradients: Iterable, flags: Any = dr.ADFlag.Default) -> None:
    """Backpropagate given gradients, one per value, to whatever the values were computed from."""
    for value, gradient in zip(values, gradients):
        if dr.grad_enabled(value):
            dr.set_grad(value, gradient)
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward, flags)
