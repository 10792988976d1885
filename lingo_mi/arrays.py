"""Arrays of any library as NumPy's."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from lingo_mi.errors import InputError


def as_numpy(values: Any, name: str, dtype: DTypeLike | None = None) -> np.ndarray:
    """`values` as an array, without a copy where that is possible.

    values   numbers, nested lists of them, or an array of any library that has `__array__` or `__dlpack__`: NumPy, PyTorch,
             Dr.Jit, JAX, ...
    name     what they are, for messages
    dtype    of the result; default: their own

    Raises InputError where they are no array, or one that NumPy cannot reach, such as a PyTorch tensor on a GPU.

        as_numpy(torch.zeros(3), 'the projections', np.float32)
    """
    try:
        if hasattr(values, '__dlpack__') and not hasattr(values, '__array__'):
            values = np.from_dlpack(values)
        return np.asarray(values, dtype)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        why = ' '.join(str(error).split()).rstrip('.')
        raise InputError(f'{name} cannot be read as an array ({why}); give a NumPy array') from None
