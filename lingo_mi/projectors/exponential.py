"""2^x for x <= 0, on the CPU with half the operations of Dr.Jit's own."""

from __future__ import annotations

from typing import Any

import drjit as dr

HALF_LOG2E = 0.7213475204444817  # exp(-x / 2) = 2^(-HALF_LOG2E x)

# 2^f - 1 = f (C[0] + C[1] f + ... + C[5] f^5) for |f| <= 1/2, minimax: the largest relative error is 2e-9.
C = (
    0.6931472028550588,
    0.24022647913637582,
    0.05550332471146941,
    0.009618437356681133,
    0.0013398874407207914,
    0.0001535336216599145,
)
ROUNDER = 1.5 * 2**23  # near it, float32 has no fraction; the last bits hold the added whole number


def exp2_of_negative(x: Any) -> Any:
    """2^x for x <= 0, to float32's rounding; at least 2^-126."""
    if dr.backend_v(x) == dr.JitBackend.CUDA:  # a hardware instruction
        return dr.exp2(x)
    x = dr.maximum(x, -126)
    rounded = x + ROUNDER
    f = x - (rounded - ROUNDER)
    f2 = f * f
    a, b, c = (dr.fma(C[k + 1], f, C[k]) for k in (0, 2, 4))
    power = dr.fma(dr.fma(dr.fma(c, f2, b), f2, a), f, 1)
    Int = dr.int32_array_t(type(x))
    exponent: Any = dr.reinterpret_array(Int, rounded)
    return dr.reinterpret_array(type(x), dr.reinterpret_array(Int, power) + (exponent << 23))
