"""JAX's arrays through Dr.Jit, by way of the host: a callback, so that it works within `jax.jit` and on any device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lingo_mi.common.runtime import drjit_lock
from lingo_mi.functional.frameworks import Argument
from lingo_mi.projectors.upload import uploaded_tensor


def call_jax(function: Callable[..., Any], arguments: Sequence[Argument], shape: tuple[int, ...]) -> Any:
    """A function of Dr.Jit's tensors, of JAX's arrays: float32 of that shape, differentiable in reverse mode."""
    # Float64, which JAX has only if the caller has enabled it, stays float64 in the computation.
    arrays = [a.array if a.double and a.array.dtype == np.float64 else a.array.astype(jnp.float32) for a in arguments]

    def tensors_of(host):
        return [uploaded_tensor(x, a.double) for x, a in zip(host, arguments)]

    def values(*host):
        return function(*tensors_of(host)).numpy()

    def gradients(upstream, *host):
        tensors = tensors_of(host)
        dr.enable_grad(tensors)
        dr.set_grad(out := function(*tensors), uploaded_tensor(upstream))
        dr.enqueue(dr.ADMode.Backward, out)
        dr.traverse(dr.ADMode.Backward)
        return [dr.grad(x).numpy().astype(a.dtype) for x, a in zip(tensors, host)]

    @jax.custom_vjp
    def operator(*arrays):
        return _on_host(values, jax.ShapeDtypeStruct(shape, jnp.float32), *arrays)

    def backward(arrays, upstream):
        return tuple(_on_host(gradients, [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in arrays], upstream, *arrays))

    operator.defvjp(lambda *arrays: (operator(*arrays), arrays), backward)
    return operator(*arrays)


def _on_host(function, result, *arrays):
    """function(*arrays) of NumPy's arrays; a callback only while JAX traces, since its errors would hide ours."""

    def of_numpy(*arrays):
        with drjit_lock():
            return function(*map(np.asarray, arrays))

    if any(isinstance(a, Tracer) for a in arrays):
        return jax.pure_callback(of_numpy, result, *arrays, vmap_method='sequential')
    return jax.tree.map(jnp.asarray, of_numpy(*arrays))
