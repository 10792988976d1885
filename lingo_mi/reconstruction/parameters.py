"""Checks of the algorithms' parameters."""

from __future__ import annotations

import numpy as np

from lingo_mi.errors import InputError

LARGE = 1e18  # upper bound of parameters without their own; float32 cannot hold the square of larger ones
ORDERS = ('ordered', 'random', 'angularDistance')


def check_counts(least: int = 1, **counts: float) -> None:
    """Raises InputError for a count that is not an integer, or below `least`."""
    for name, value in counts.items():
        if not (least <= value < np.inf and value == int(value)):
            raise InputError(f'{name} must be an integer from {least} on, not {value}')


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raises InputError for a parameter outside low < value <= high."""
    if not low < value <= high:
        raise InputError(f'{name} must be above {low:g} and at most {high:g}, not {value}')


def check_bound(name: str, value: float, high: float = LARGE) -> None:
    """Raises InputError for a parameter, which may be zero, outside 0 <= value <= high."""
    if not 0 <= value <= high:
        raise InputError(f'{name} must be from 0 to {high:g}, not {value}')


def check_order(order: str) -> None:
    """Raises InputError for an OrderStrategy that is not in `ORDERS`."""
    if order not in ORDERS:
        raise InputError(f'OrderStrategy {order!r} is unknown: use one of {", ".join(ORDERS)}')
