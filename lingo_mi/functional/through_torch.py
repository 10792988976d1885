"""PyTorch's tensors through Dr.Jit: shared memory, one graph of derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import torch

from lingo_mi.errors import InputError
from lingo_mi.runtime import ensure_variant


def call_torch(function: Callable[..., Any], arrays: Sequence, name: str) -> Any:
    """A function of Dr.Jit's tensors, of PyTorch's: float32 on their device, with gradients."""
    devices = {a.device for a in arrays}
    if len(devices) > 1 or next(iter(devices)).type not in ('cpu', 'cuda'):
        raise InputError(
            f'{name}: the tensors must all be on the CPU or on one CUDA device, not on {", ".join(map(str, devices))}'
        )
    ensure_variant(devices.pop().type)
    # Dr.Jit takes plain tensors alone: not nn.Parameter, which is a class of its own.
    plain = [a.as_subclass(torch.Tensor).to(torch.float32).contiguous() for a in arrays]
    if not torch.is_grad_enabled():  # what derivatives need would be kept
        plain = [a.detach() for a in plain]
    return dr.wrap(source='torch', target='drjit')(function)(*plain)
