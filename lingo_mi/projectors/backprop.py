"""Chains of derivatives that are cut in two: what lies behind the cut is differentiated first, and its derivatives passed on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr


def leaves(values: Iterable) -> Any:
    """Copies that gather derivatives, cut off from what the values were made of."""
    copies = tuple(dr.detach(v) for v in values)
    dr.enable_grad(copies)
    return copies


def pass_on(values: Iterable, gradients: Iterable, flags: Any = dr.ADFlag.Default) -> None:
    """Propagate derivatives by some values, one each, through the making of these."""
    for value, gradient in zip(values, gradients):
        if dr.grad_enabled(value):
            dr.set_grad(value, gradient)
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward, flags)
