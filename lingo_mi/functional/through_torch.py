"""PyTorch's tensors through Dr.Jit: one operation of PyTorch's graph, whose derivatives are Dr.Jit's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import drjit_lock, ensure_variant, warn_of_spinning
from lingo_mi.functional.frameworks import Argument


def call_torch(function: Callable[..., Any], arguments: Sequence[Argument], name: str) -> Any:
    """A function of Dr.Jit's tensors, of PyTorch's: float32 on their device, with gradients."""
    devices = {a.array.device for a in arguments}
    if len(devices) > 1 or next(iter(devices)).type not in ('cpu', 'cuda'):
        raise InputError(
            f'{name}: the tensors must all be on the CPU or on one CUDA device, not on {", ".join(map(str, devices))}'
        )
    device = devices.pop().type
    ensure_variant(device)
    if device == 'cpu':
        warn_of_spinning()
    # Dr.Jit takes plain tensors alone: not nn.Parameter, which is a class of its own.
    plain = [
        a.array.as_subclass(torch.Tensor).to(torch.float64 if a.double else torch.float32).contiguous()
        for a in arguments
    ]
    return _OfDrJit.apply(function, *plain)


class _OfDrJit(torch.autograd.Function):
    """`drjit.wrap` would give the first derivatives again if PyTorch goes back through one graph twice."""

    @staticmethod
    def forward(ctx: Any, function: Callable[..., Any], *arrays: torch.Tensor) -> torch.Tensor:
        tensors: Any = [_tensor(a.detach()) for a in arrays]
        wanted = ctx.needs_input_grad[1:]
        for tensor, is_wanted in zip(tensors, wanted):
            if is_wanted:
                dr.enable_grad(tensor)
        result = function(*tensors)
        if any(wanted):
            ctx.graph = tensors, result
            ctx.save_for_backward(*arrays)  # it raises if PyTorch has freed the graph
        return dr.detach(result).torch().clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: torch.Tensor) -> tuple:
        tensors, result = ctx.graph
        assert ctx.saved_tensors
        with drjit_lock():
            dr.clear_grad(tensors)
            dr.set_grad(result, _tensor(upstream.contiguous()))
            dr.enqueue(dr.ADMode.Backward, result)
            dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearInterior)
            wanted = zip(tensors, ctx.needs_input_grad[1:])
            return None, *(dr.grad(tensor).torch().clone() if is_wanted else None for tensor, is_wanted in wanted)


def _tensor(array: Any) -> mi.TensorXf:
    """In the memory of PyTorch's."""
    tensor: Any = mi.TensorXd if array.dtype == torch.float64 else mi.TensorXf
    return tensor(array)
