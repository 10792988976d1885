"""Copies of NumPy's values on the device."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike


def uploaded(values: np.ndarray, double: bool = False) -> Any:
    """A copy of NumPy's values, of any shape, as Float [N] that begins at a multiple of 64 bytes, like Dr.Jit's own arrays.

    Dr.Jit uses NumPy's memory in place and compiles its alignment into kernels. Without this copy, each densification would
    compile new ones.

    Parameters
    ----------
    double : bool
        Whether it is Float64.
    """
    room = np.empty(values.size + 16, np.float64 if double else np.float32)
    start = -room.ctypes.data % 64 // room.itemsize
    out = room[start : start + values.size]
    out.reshape(values.shape)[...] = values
    out = mi.Float64(out) if double else mi.Float(out)
    dr.make_opaque(out)  # a single value would otherwise become a literal, compiled into kernels
    return out


def uploaded_tensor(values: ArrayLike, double: bool = False) -> Any:
    """A copy of NumPy's values of any shape: TensorXf, or TensorXd if they are to be double."""
    tensor: Any = mi.TensorXd if double else mi.TensorXf
    return tensor(uploaded(np.asarray(values), double), np.shape(values))
