"""Arrays of other packages as NumPy's."""

from __future__ import annotations

import numpy as np


def as_numpy(values) -> np.ndarray:
    """An array as NumPy sees it: whatever has `__array__` or `__dlpack__`, or is a sequence of numbers. Copies if it must."""
    if not hasattr(values, '__array__') and hasattr(values, '__dlpack__'):
        return np.from_dlpack(values)
    return np.asarray(values)
