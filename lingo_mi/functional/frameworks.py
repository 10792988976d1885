"""From the caller's arrays to Dr.Jit's and back: NumPy and Dr.Jit here, PyTorch and JAX in modules of their own.

Neither PyTorch nor JAX is a dependency: arrays of theirs cannot come from a caller who has not imported them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import ensure_variant, one_at_a_time
from lingo_mi.projectors.upload import uploaded_tensor

NAMES = 'means', 'scales', 'quaternions', 'density'
COMPONENTS = (3,), (3,), (4,), ()  # of each Gaussian


def call(function: Callable[..., Any], arrays: Sequence, shape: tuple[int, ...], name: str) -> Any:
    """function(centre, scale, rotation, density), which is Dr.Jit's, of a caller's arrays; a result of the caller's kind.

    function   takes Point3f, Vector3f, Vector4f and Float [N], returns Float [prod(shape)]; differentiable
    arrays     [N, 3], [N, 3], [N, 4] and [N], all of one kind
    shape      of the result
    name       of the caller, for messages

    Raises InputError for arrays of several kinds, of other shapes, or on a device that the active variant does not use.
    """
    kind = _kind(arrays, name)
    if kind == 'NumPy':
        arrays = [as_numpy(a, f'{name}: {n}', np.float32) for a, n in zip(arrays, NAMES)]
    _check_shapes(arrays, name)

    def of_tensors(*tensors):
        return mi.TensorXf(function(*_gaussians(tensors)), shape)

    if kind == 'NumPy':
        with one_at_a_time():
            ensure_variant()
            return of_tensors(*map(uploaded_tensor, arrays)).numpy()
    if kind == 'Dr.Jit':
        with one_at_a_time():
            ensure_variant('cuda' if dr.backend_v(arrays[0]) == dr.JitBackend.CUDA else 'cpu')
            return of_tensors(*arrays)
    # Imported here, because PyTorch and JAX are heavy and may be missing.
    if kind == 'PyTorch':
        from lingo_mi.functional.through_torch import call_torch

        with one_at_a_time():
            return call_torch(of_tensors, arrays, name)
    from lingo_mi.functional.through_jax import call_jax

    ensure_variant()
    return call_jax(of_tensors, arrays, shape)


def _kind(arrays, name: str) -> str:
    kinds = [framework_of(a) for a in arrays]
    if len(set(kinds)) > 1:
        found = ', '.join(f'{n} of {k}' for n, k in zip(NAMES, kinds))
        raise InputError(f'{name}: the arrays must be of one kind, not {found}')
    return kinds[0]


def framework_of(array) -> str:
    """'NumPy', 'Dr.Jit', 'PyTorch' or 'JAX', without importing the last two."""
    if dr.is_array_v(array):
        return 'Dr.Jit'
    packages = {base.__module__.partition('.')[0] for base in type(array).__mro__}
    return 'PyTorch' if 'torch' in packages else 'JAX' if packages & {'jax', 'jaxlib'} else 'NumPy'


def _check_shapes(arrays, name: str):
    shapes = [_shape(a) for a in arrays]
    count = shapes[0][0] if shapes[0] else 0
    for what, found, components in zip(NAMES, shapes, COMPONENTS):
        if found != (count, *components):
            wanted = [count if what != 'means' and shapes[0] else 'N', *components]
            raise InputError(
                f'{name}: {what} must be of the shape [{", ".join(map(str, wanted))}], not [{", ".join(map(str, found))}]'
            )
    if count == 0:
        raise InputError(f'{name}: the cloud is empty: it needs at least one Gaussian')


def _shape(array) -> tuple[int, ...]:
    shape = tuple(array.shape)
    # Dr.Jit's vectors have their components first.
    return shape[::-1] if dr.is_array_v(array) and not dr.is_tensor_v(array) else shape


def _gaussians(tensors):
    """Point3f, Vector3f, Vector4f and Float [N] of the four arrays, evaluated together.

    They are copies in Dr.Jit's own memory: the kernels that follow would otherwise depend on how the caller's is aligned.
    """
    flat = [x.array if dr.is_tensor_v(x) else x for x in tensors]
    dr.make_opaque(flat)  # a literal would be compiled in
    columns = []
    for array, tensor, Type, components in zip(flat, tensors, _types(), COMPONENTS):
        if dr.is_tensor_v(tensor):
            size, array = components or (1,), mi.Float(array)
            i = dr.arange(mi.UInt32, tensor.shape[0]) * size[0]
            # Every entry is read once, so the derivative needs no atomics.
            array = Type(*(dr.gather(mi.Float, array, i + j, mode=dr.ReduceMode.Permute) for j in range(*size)))
        columns.append(Type(array))
    dr.eval(columns)
    return columns


def _types():
    return mi.Point3f, mi.Vector3f, mi.Vector4f, mi.Float
