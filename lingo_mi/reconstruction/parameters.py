"""Checks of the algorithms' parameters."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

from lingo_mi.common.errors import InputError

LARGE = 1e18  # upper bound of parameters without their own; float32 cannot hold the square of larger ones
ORDERS = ('ordered', 'random', 'angularDistance')


def check_counts(least: int = 1, **counts: float) -> None:
    """Raises InputError for a count that is not an integer, or below `least`."""
    for name, value in counts.items():
        if not (_number(value) and isinstance(value, Integral) and least <= value):
            raise InputError(f'{name} must be an integer from {least} on, not {value!r}')


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raises InputError for a parameter outside low < value <= high."""
    if not (_number(value) and low < value <= high):
        raise InputError(f'{name} must be above {low:g} and at most {high:g}, not {value!r}')


def check_bound(name: str, value: float, high: float = LARGE) -> None:
    """Raises InputError for a parameter, which may be zero, outside 0 <= value <= high."""
    if not (_number(value) and 0 <= value <= high):
        raise InputError(f'{name} must be from 0 to {high:g}, not {value!r}')


def check_order(order: str) -> None:
    """Raises InputError for an OrderStrategy that is not in `ORDERS`."""
    if order not in ORDERS:
        raise InputError(f'OrderStrategy {order!r} is unknown: use one of {", ".join(ORDERS)}')


def _number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
