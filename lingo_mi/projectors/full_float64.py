"""Float64 on NVIDIA GPUs with all of its digits.

With Dr.Jit's `JitFlag.FastMath`, which is on by default, CUDA takes float64 reciprocals with 20 bits: not in a scalar `y / x`,
but in `rcp`, `rsqrt`, `normalize`, a vector over a scalar, `tan`, and in the derivatives of divisions, roots and logarithms. What
counts is whether it is on when an operation is traced, not when it is compiled.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi


@contextmanager
def full_float64() -> Iterator[None]:
    """Trace float64 operations in full precision; also a decorator. No change on the CPU, which has it anyway.

    float32 operations are then slower on a GPU: leave loops over pixels out.
    """
    fast = dr.flag(dr.JitFlag.FastMath) and dr.backend_v(mi.Float) != dr.JitBackend.CUDA
    with dr.scoped_set_flag(dr.JitFlag.FastMath, fast):
        yield
