"""Linear maps of JAX's arrays, by way of the host: a primitive, so that all of JAX's transformations apply."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from lingo_mi.functional.linear_map import LinearMap


def apply_jax(linear_map: LinearMap, x: Any) -> Any:
    """The map of an array [..., *domain_shape] of real numbers, which is computed as float32."""
    return _PRIMITIVE.bind(x if x.dtype == jnp.float32 else x.astype(jnp.float32), map=linear_map, checked=True)


def _shape(x, linear_map):
    return *x.shape[: x.ndim - len(linear_map.domain_shape)], *linear_map.range_shape


def _values(x, *, map, checked):
    if not isinstance(x, Tracer):  # JAX would wrap our errors
        return jnp.asarray(map.on_host(np.asarray(x), checked))
    result = jax.ShapeDtypeStruct(_shape(x, map), jnp.float32)
    return jax.pure_callback(lambda x: map.on_host(np.asarray(x), checked), result, x)


def _derivative(x, *, map):
    """The map of tangents or cotangents, which may be infinite."""
    return _PRIMITIVE.bind(x, map=map, checked=False)


_PRIMITIVE = Primitive('lingo_mi_linear_map')
_PRIMITIVE.def_impl(_values)
_PRIMITIVE.def_abstract_eval(lambda x, *, map, checked: ShapedArray(_shape(x, map), x.dtype))
ad.deflinear2(_PRIMITIVE, lambda cotangent, x, *, map, checked: [_derivative(cotangent, map=map.T)])
ad.defjvp(_PRIMITIVE, lambda tangent, x, *, map, checked: _derivative(tangent, map=map))
batching.primitive_batchers[_PRIMITIVE] = lambda xs, axes, **options: (
    _PRIMITIVE.bind(jnp.moveaxis(xs[0], axes[0], 0), **options),
    0,
)
mlir.register_lowering(_PRIMITIVE, mlir.lower_fun(_values, multiple_results=False))
