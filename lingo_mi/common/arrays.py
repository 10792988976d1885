"""Arrays of any library as NumPy's, and how records of arrays are printed."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from lingo_mi.common.errors import InputError


def as_numpy(values: Any, name: str, dtype: DTypeLike | None = None) -> np.ndarray:
    """`values` as an array, without a copy if that is possible.

    Parameters
    ----------
    values
        Numbers, nested lists of them, or an array of any library that has `__array__` or `__dlpack__`: NumPy, PyTorch, Dr.Jit,
        JAX, ...
    name : str
        Name of the values, for messages.
    dtype : DTypeLike or None
        Type of the result; default: their own.

    Raises
    ------
    InputError
        If they are not an array of real numbers, or if NumPy cannot reach the array, such as a PyTorch tensor on a GPU. Also if
        some are masked, because the mask would be lost.

    Examples
    --------
    >>> as_numpy(torch.zeros(3), 'the projections', np.float32)
    """
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise InputError(
            f'{name}: some values are masked, and the mask would be lost: fill them first, as by filled(0)'
        )
    try:
        if hasattr(values, '__dlpack__') and not hasattr(values, '__array__'):
            values = np.from_dlpack(values)
        array = np.asarray(values)
        if array.dtype.kind in 'cSUOMm':  # NumPy would take text for numbers, and drop imaginary parts
            raise TypeError(f'its values are {array.dtype}, not real numbers')
        return np.asarray(array, dtype)
    except (TypeError, ValueError, OverflowError, RuntimeError, BufferError) as error:
        why = ' '.join(str(error).split()).rstrip('.')
        raise InputError(f'{name} cannot be read as an array ({why}); give a NumPy array') from None


def short_repr(self: Any) -> str:
    """The repr of a dataclass with arrays as types and shapes, such as `float32[50, 512, 512]`, and nothing for None."""

    def short(value) -> str:
        if isinstance(value, np.ndarray):
            return f'{value.dtype}{list(value.shape)}'
        if isinstance(value, list) and len(value) > 4:
            return f'[{value[0]!r}, ..., {value[-1]!r}]'
        return repr(value)

    values = ((f.name, getattr(self, f.name)) for f in fields(self) if f.repr)
    return f'{type(self).__name__}({", ".join(f"{n}={short(v)}" for n, v in values if v is not None)})'
