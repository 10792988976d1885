"""Backpropagation in two stages: first from the loss to copies (`leaves`), then from these to the inputs (`pass_on`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi


def leaves(values: Iterable) -> Any:
    """Detached copies that accumulate derivatives."""
    copies = tuple(dr.detach(v) for v in values)
    dr.enable_grad(copies)
    return copies


def pass_on(values: Iterable, gradients: Iterable, flags: Any = dr.ADFlag.Default) -> None:
    """Backpropagate given gradients, one per value, to whatever the values were computed from."""
    for value, gradient in zip(values, gradients):
        if dr.grad_enabled(value):
            dr.accum_grad(value, gradient)  # a value may be an input itself, with the derivatives of other views
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward, flags)


class Cuts:
    """A computation cut into parts that are backpropagated one after another, last first, each in a kernel of its own.

    A kernel needs registers for all values that its derivatives refer to, so a long one leaves room for few warps on a GPU. On
    the CPU, where it would only take time, nothing is cut.

    Parameters
    ----------
    active : bool or None
        Whether to cut; None: on a GPU.
    """

    def __init__(self, active: bool | None = None):
        self.active = dr.backend_v(mi.Float) == dr.JitBackend.CUDA if active is None else active
        self.parts: list[tuple] = []

    def __call__(self, *values: Any) -> Any:
        """Copies of intermediate values, to go on with. No value may be given twice."""
        if not self.active:
            return values
        copies = dr.detach(values)
        dr.eval(copies)
        dr.enable_grad(copies)
        self.parts.append((values, copies))
        return copies

    def pass_on(self, values: Iterable, gradients: Iterable, flags: Any = dr.ADFlag.Default) -> None:
        """Pass on derivatives through all parts, like the function `pass_on`."""
        keep = dr.ADFlag.ClearVertices  # parts may share the graph of what comes before them
        pass_on(values, gradients, keep if self.parts else flags)
        while self.parts:
            values, copies = self.parts.pop()
            derivatives = [dr.grad(copy) for copy in copies]
            dr.eval(derivatives)
            pass_on(values, derivatives, keep if self.parts else flags)
