"""Copies of NumPy's values on the device."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike


def uploaded(values: np.ndarray) -> Any:
    """A copy of NumPy's values, Float [N], that begins at a multiple of 64 bytes, like Dr.Jit's own arrays.

    Dr.Jit reads NumPy's memory in place and compiles its alignment into the kernels, which would then be others after every
    densification.
    """
    room = np.empty(len(values) + 16, np.float32)
    start = -room.ctypes.data % 64 // 4
    out = room[start : start + len(values)]
    out[:] = values
    out = mi.Float(out)
    dr.make_opaque(out)  # one value alone would otherwise be a literal, and be compiled in
    return out


def uploaded_tensor(values: ArrayLike) -> Any:
    """A copy of NumPy's values of any shape, TensorXf."""
    return mi.TensorXf(uploaded(np.ravel(values)), np.shape(values))
