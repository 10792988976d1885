"""Limits of the numbers of a scan, so that everything made from them stays finite.

Lengths, in mm or whatever unit a scan has, are zero or from 1e-12 to 1e12, and no two of a scan's are further apart than
that: products of three, which projectors form, then fit into float32 in any frame. These are the limits of Gaussians too
(`lingo_mi.projectors.usable`). Products of three counts fit into 64 bits.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from lingo_mi.common.errors import InputError, shown

MOST_LENGTH = 1e12
LEAST_LENGTH = 1 / MOST_LENGTH
MOST_ANGLE = 1e6  # radians, which float64 knows to 1e-10
MOST_COUNT = 1_000_000  # pixels or voxels along an axis
MOST_VIEWS = 100_000


def numbers(name: str, value: ArrayLike) -> np.ndarray:
    """`value` as float64, of any shape.

    Raises
    ------
    InputError
        If it is not made of numbers, or one is beyond float64.
    """
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f'{name} must be made of numbers, not {shown(value)}') from None
    except RuntimeError:  # what PyTorch raises for a tensor that has a gradient
        raise InputError(f'{name}: a geometry keeps no derivatives: detach the tensor first') from None


def lengths(name: str, value: ArrayLike) -> np.ndarray:
    """`value` as float64, of any shape and sign.

    Raises
    ------
    InputError
        If one is not finite, or too long.
    """
    array = numbers(name, value)
    if not np.all(np.abs(array) <= MOST_LENGTH):
        raise InputError(f'{name} must be finite lengths, at most {MOST_LENGTH:.0e}, not {shown(value)}')
    return array


def angles(name: str, value: ArrayLike) -> np.ndarray:
    """`value` in radians as float64, of any shape.

    Raises
    ------
    InputError
        If one is not finite, or of too many turns.
    """
    array = numbers(name, value)
    if not np.all(np.abs(array) <= MOST_ANGLE):
        raise InputError(f'{name} must be finite numbers, at most {MOST_ANGLE:.0e} radians, not {shown(value)}')
    return array


def vector(name: str, value: ArrayLike, length: int) -> tuple:
    """`length` floats, lengths of any sign; one number may stand for all.

    Raises
    ------
    InputError
        If it is anything else.
    """
    array = np.atleast_1d(numbers(name, value)).ravel()
    if len(array) == 1:
        array = np.repeat(array, length)
    if len(array) != length or not np.all(np.isfinite(array)):
        raise InputError(
            f'{name} must be {"one finite number" if length == 1 else f"{length} finite numbers"}, not {shown(value)}'
        )
    return tuple(float(x) for x in lengths(name, array))


def sizes(name: str, value: ArrayLike, length: int) -> tuple:
    """`length` positive lengths, as `vector` takes them."""
    values = vector(name, value, length)
    if min(values) <= 0:
        raise InputError(f'{name} must be positive, not {values}')
    return values


def counts(name: str, value: ArrayLike, length: int) -> tuple:
    """`length` whole numbers from 1 to `MOST_COUNT`, as `vector` takes them."""
    values = vector(name, value, length)
    if any(x % 1 for x in values):
        raise InputError(f'{name} must be whole numbers, not {shown(value)}')
    values = tuple(map(int, values))
    if min(values) <= 0:
        raise InputError(f'{name} must be positive, not {values}')
    if max(values) > MOST_COUNT:
        raise InputError(f'{name} must be at most {MOST_COUNT} along an axis, not {shown(values)}')
    return values


def require_proportions(long: Iterable[float], short: Iterable[float]) -> None:
    """Raises InputError if the longest length of a scan is too many times the shortest. Zeros do not count."""
    longest, shortest = (max(map(abs, long)), min(map(abs, short)))
    if not (LEAST_LENGTH <= shortest and longest <= MOST_LENGTH and longest <= MOST_LENGTH * shortest):
        raise InputError(
            f'the lengths of a scan must lie between {LEAST_LENGTH:.0e} and {MOST_LENGTH:.0e}, and within a factor of '
            f'{MOST_LENGTH:.0e}: these are from {shortest:g} to {longest:g}'
        )
