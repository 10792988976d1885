"""Conversions between raw parameters and the numbers of a Gaussian. NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np


def softplus(x: Any) -> np.ndarray:
    """ln(1 + e^x), without overflow."""
    return np.logaddexp(0.0, x)


def inverse_softplus(y: Any) -> np.ndarray:
    """x with softplus(x) = y. y is raised to at least 1e-30, since 0 has no inverse."""
    y = np.maximum(y, 1e-30)
    return y + np.log(-np.expm1(-y))


def sigmoid(x: Any) -> np.ndarray:
    """1 / (1 + e^-x)."""
    return 1 / (1 + np.exp(-x))


def inverse_sigmoid(y: Any) -> np.ndarray:
    """x with sigmoid(x) = y, for y in (0, 1)."""
    return np.log(y) - np.log1p(-y)


def inverse_scale(scale: Any, low: float, high: float) -> np.ndarray:
    """Raw scale of a standard deviation strictly between the bounds."""
    return inverse_sigmoid((scale - low) / (high - low))
