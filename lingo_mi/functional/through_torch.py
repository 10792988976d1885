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
    wanted = [torch.is_grad_enabled() and a.requires_grad for a in plain]
    return _OfDrJit.apply(_Recording(function, wanted, name), *plain)


class _Recording:
    """Dr.Jit's graph of one call, from PyTorch's forward pass to its backward passes."""

    def __init__(self, function: Callable[..., Any], wanted: Sequence[bool], name: str):
        self.function, self.wanted, self.name = function, wanted, name

    def values(self, arrays: Sequence[torch.Tensor]) -> torch.Tensor:
        self.tensors: Any = [_tensor(a.detach()) for a in arrays]
        for tensor, is_wanted in zip(self.tensors, self.wanted):
            if is_wanted:
                dr.enable_grad(tensor)
        self.result = self.function(*self.tensors)
        return dr.detach(self.result).torch().clone()

    def gradients(self, upstream: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The gradients by the arrays that are wanted."""
        with drjit_lock():
            dr.clear_grad(self.tensors)
            dr.set_grad(self.result, _tensor(upstream.detach().contiguous()))
            dr.enqueue(dr.ADMode.Backward, self.result)
            dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearInterior)
            return tuple(dr.grad(t).torch().clone() for t, is_wanted in zip(self.tensors, self.wanted) if is_wanted)


class _Function(torch.autograd.Function):
    """A function of a `_Recording` and of tensors, with derivatives in reverse mode only."""

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> None:
        raise InputError(f'{ctx.recording.name} has no forward mode in PyTorch: take torch.func.grad or torch.func.vjp')

    @staticmethod
    def vmap(info: Any, in_dims: tuple, recording: _Recording, *_: Any) -> None:
        raise InputError(f'{recording.name} has no torch.func.vmap: call it once for each item of the batch')


class _OfDrJit(_Function):
    """`drjit.wrap` would give the first derivatives again if PyTorch goes back through one graph twice."""

    @staticmethod
    def forward(recording: _Recording, *arrays: torch.Tensor) -> torch.Tensor:
        return recording.values(arrays)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
        ctx.recording, *arrays = inputs
        ctx.save_for_backward(*arrays)  # it raises if PyTorch has freed the graph

    @staticmethod
    def backward(ctx: Any, upstream: torch.Tensor) -> tuple:
        gradients = iter(_Gradients.apply(ctx.recording, upstream, *ctx.saved_tensors))
        return None, *(next(gradients) if is_wanted else None for is_wanted in ctx.recording.wanted)


class _Gradients(_Function):
    """The gradients, as a function of the arrays: PyTorch would otherwise leave out second derivatives without an error."""

    @staticmethod
    def forward(recording: _Recording, upstream: torch.Tensor, *_: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return recording.gradients(upstream)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[torch.Tensor, ...]) -> None:
        ctx.recording = inputs[0]

    @staticmethod
    def backward(ctx: Any, *_: torch.Tensor) -> None:
        raise InputError(f'{ctx.recording.name} has first derivatives only, and this is the derivative of one')


def _tensor(array: Any) -> mi.TensorXf:
    """In the memory of PyTorch's."""
    tensor: Any = mi.TensorXd if array.dtype == torch.float64 else mi.TensorXf
    return tensor(array)
