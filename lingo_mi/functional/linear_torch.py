"""Linear maps of PyTorch's tensors: differentiable in both modes, any number of times, and vectorised by `torch.func.vmap`."""

from __future__ import annotations

import inspect
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import drjit_lock, ensure_variant, warn_of_spinning
from lingo_mi.functional.linear_map import LinearMap

ALIGNED = 64  # bytes at which Dr.Jit's own arrays begin; the alignment of others is compiled into kernels


def apply_torch(linear_map: LinearMap, x: torch.Tensor) -> torch.Tensor:
    """The map of a tensor [..., *domain_shape] of real numbers, which is computed as float32."""
    if x.device.type not in ('cpu', 'cuda'):
        raise InputError(f'{linear_map!r} takes tensors on the CPU or on a CUDA device, not on {x.device}')
    if x.device.type == 'cpu':
        warn_of_spinning()
    return _Apply.apply(x.as_subclass(torch.Tensor).to(torch.float32), linear_map, True)


class _Apply(torch.autograd.Function):
    @staticmethod
    def forward(x: torch.Tensor, linear_map: LinearMap, checked: bool) -> torch.Tensor:
        x = x.detach().contiguous()
        if checked and x.device.type == 'cpu':
            linear_map.require_finite(np.isfinite(x.numpy()))  # NumPy is several times as quick to tell
        elif checked and not (finite := torch.isfinite(x)).all():
            linear_map.require_finite(finite.cpu().numpy())
        with drjit_lock():
            active = ensure_variant(None if x.device.type == 'cpu' else 'cuda')
            if x.device.type == 'cpu' and active.startswith('cuda'):
                return torch.from_numpy(linear_map.on_host(x.numpy(), checked=False))
            batch = x.shape[: x.dim() - len(linear_map.domain_shape)]
            if x.device.type == 'cuda':
                torch.cuda.current_stream(x.device).synchronize()  # Dr.Jit has a stream of its own
            out = [_apply(linear_map, part) for part in x.reshape(-1, *linear_map.domain_shape)]
        if not batch:
            return out[0]
        stacked = torch.stack(out) if out else x.new_empty(0)
        return stacked.reshape(*batch, *linear_map.range_shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
        ctx.map = inputs[1]

    # Derivatives are not checked: a GradScaler skips a step whose gradients are infinite.
    @staticmethod
    def backward(ctx: Any, upstream: torch.Tensor) -> tuple:
        return _Apply.apply(upstream, ctx.map.T, False), None, None

    @staticmethod
    def jvp(ctx: Any, tangent: torch.Tensor, *_: Any) -> torch.Tensor:
        return _Apply.apply(tangent, ctx.map, False)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, x: torch.Tensor, linear_map: LinearMap, checked: bool) -> tuple:
        return _Apply.apply(x.movedim(in_dims[0], 0), linear_map, checked), 0


# PyTorch asks for it at every call, and would work it out each time.
_Apply.forward.__signature__ = inspect.signature(_Apply.forward)  # pyright: ignore[reportFunctionMemberAccess]


def _apply(linear_map: LinearMap, x: torch.Tensor) -> torch.Tensor:
    """The map of one contiguous tensor, in whose memory Dr.Jit reads."""
    x = x.reshape(-1)
    if x.data_ptr() % ALIGNED:
        x = x.clone()
    out: Any = mi.TensorXf(linear_map.on_device(mi.Float(x)), linear_map.range_shape).torch()
    dr.sync_thread()
    return out
