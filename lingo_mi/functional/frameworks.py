"""From the caller's arrays to Dr.Jit's and back: NumPy and Dr.Jit here, PyTorch and JAX in modules of their own.

Neither PyTorch nor JAX is a dependency: arrays of theirs cannot come from a caller who has not imported them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import drjit_lock, ensure_variant
from lingo_mi.projectors.upload import uploaded_tensor


@dataclass(frozen=True)
class Argument:
    """An array that a caller gave.

    Parameters
    ----------
    name : str
        For messages.
    array
        An array of any kind.
    shape : tuple[int or None, ...]
        Shape that it must have; None for a size that the first argument with a None decides.
    double : bool
        Whether it is computed on in float64, not in float32.
    """

    name: str
    array: Any
    shape: tuple[int | None, ...]
    double: bool = False


def call(function: Callable[..., Any], arguments: Sequence[Argument], shape: tuple[int, ...], name: str) -> Any:
    """A differentiable function of Dr.Jit's tensors, of a caller's arrays; a result of the caller's kind.

    Parameters
    ----------
    function : callable
        Takes a tensor for each argument, or what a caller of Dr.Jit gave in its place; returns Float [prod(shape)].
    arguments : Sequence[Argument]
        Arrays of one kind.
    shape : tuple[int, ...]
        Shape of the result.
    name : str
        Name of the caller, for messages.

    Raises
    ------
    InputError
        For arrays of several kinds, of other shapes, or on a device that the active variant does not use; see `require_dense`.
    """
    kind = _kind(arguments, name)
    for argument in arguments:
        require_dense(argument.array, kind, name)
    if kind == 'NumPy':
        arguments = [_on_host(a, name) for a in arguments]
    _check_shapes(arguments, name)
    arrays = [a.array for a in arguments]

    def of_tensors(*tensors):
        return mi.TensorXf(function(*tensors), shape)

    if kind == 'NumPy':
        with drjit_lock():
            ensure_variant()
            return of_tensors(*(uploaded_tensor(a.array, a.double) for a in arguments)).numpy()
    if kind == 'Dr.Jit':
        with drjit_lock():
            ensure_variant('cuda' if dr.backend_v(arrays[0]) == dr.JitBackend.CUDA else 'cpu')
            return of_tensors(*arrays)
    # Imported here, because PyTorch and JAX are heavy and may be missing.
    if kind == 'PyTorch':
        from lingo_mi.functional.through_torch import call_torch

        with drjit_lock():
            return call_torch(of_tensors, arguments, name)
    from lingo_mi.functional.through_jax import call_jax

    ensure_variant()
    return call_jax(of_tensors, arguments, shape)


def _on_host(argument: Argument, name: str) -> Argument:
    dtype = np.float64 if argument.double else np.float32
    return replace(argument, array=as_numpy(argument.array, f'{name}: {argument.name}', dtype))


def _kind(arguments: Sequence[Argument], name: str) -> str:
    kinds = [framework_of(a.array) for a in arguments]
    if len(set(kinds)) > 1:
        kinds_text = ', '.join(f'{a.name} of {k}' for a, k in zip(arguments, kinds))
        raise InputError(f'{name}: the arrays must be of one kind, not {kinds_text}')
    return kinds[0]


def framework_of(array) -> str:
    """'NumPy', 'Dr.Jit', 'PyTorch' or 'JAX', without importing the last two."""
    if dr.is_array_v(array):
        return 'Dr.Jit'
    packages = {base.__module__.partition('.')[0] for base in type(array).__mro__}
    return 'PyTorch' if 'torch' in packages else 'JAX' if packages & {'jax', 'jaxlib'} else 'NumPy'


def require_dense(array: Any, kind: str, name: str) -> None:
    """Raises InputError for an array of PyTorch or JAX that is sparse, nested or complex; NumPy's are checked by `as_numpy`.

    Parameters
    ----------
    kind : str
        See `framework_of`.
    name : str
        Name of the caller, for the message.
    """
    if kind == 'PyTorch' and array.is_nested:  # it has no shape
        raise InputError(f'{name} takes dense tensors, not nested ones: stack their parts first')
    if kind == 'PyTorch' and str(array.layout) != 'torch.strided':
        raise InputError(f'{name} takes dense tensors, not {array.layout}: call to_dense() first')
    if kind == 'JAX' and hasattr(array, 'todense'):
        raise InputError(f'{name} takes dense arrays, not {type(array).__name__}: call todense() first')
    if kind in ('PyTorch', 'JAX') and 'complex' in str(array.dtype):
        raise InputError(f'{name} takes real numbers, not {array.dtype}')


def _check_shapes(arguments: Sequence[Argument], name: str):
    count = None  # the size that None stands for
    for argument in arguments:
        shape = _shape(argument.array)
        size = shape[0] if shape else 0
        if shape != tuple((size if count is None else count) if n is None else n for n in argument.shape):
            wanted = ('N' if count is None else count) if None in argument.shape else None
            text = ', '.join(str(wanted if n is None else n) for n in argument.shape)
            raise InputError(
                f'{name}: {argument.name} must be of the shape [{text}], not [{", ".join(map(str, shape))}]'
            )
        if None in argument.shape and count is None:
            count = size
    if count == 0:
        raise InputError(f'{name}: the cloud is empty: it needs at least one Gaussian')


def _shape(array) -> tuple[int, ...]:
    shape = tuple(array.shape)
    # Dr.Jit's vectors have their components first.
    return shape[::-1] if dr.is_array_v(array) and not dr.is_tensor_v(array) else shape
