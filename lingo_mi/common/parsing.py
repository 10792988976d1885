"""Values of settings and parameters: from the text of a command line, and from Python."""

from __future__ import annotations

import difflib
import math
import numbers
import operator
from collections.abc import Iterable
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import numpy as np

from lingo_mi.common.errors import InputError, shown

MOST_SEED = 2**62  # two generators share the 64 bits of a detector's key


def parse(name: str, text: str, like: Any) -> Any:
    """The value that `text` says, of the kind of `like`: text, true or false, a whole number, a number, or two numbers, of
    which one stands for both.

    Raises
    ------
    InputError
        In the name of `name`.
    """
    try:
        if isinstance(like, tuple):
            numbers = tuple(float(x) for x in text.split(','))
            return numbers * 2 if len(numbers) == 1 else numbers
        if isinstance(like, bool):
            return {'true': True, 'false': False}[text.lower()]
        if isinstance(like, int):
            return _whole(text)
        return type(like)(text)
    except (ValueError, KeyError, OverflowError):
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', tuple: 'two numbers, first,last'}[
            type(like)
        ]
        raise InputError(f'{name} must be {kind}, not {shown(text)}') from None


def _whole(text):
    try:
        return int(text)  # all digits count
    except ValueError:
        if float(text) != int(float(text)):  # such as 1e4
            raise
        return int(float(text))


def checked(name: str, value: Any, like: Any) -> Any:
    """A value given in Python, after a check that it is of the kind of `like`: text, True or False, a whole number, a number, or
    two numbers. NumPy's scalars and arrays become Python's.

    Raises
    ------
    InputError
        In the name of `name`.

    Examples
    --------
    >>> checked('rate_centre', np.array([1e-3, 1e-4]), (1.0, 1.0))   # (0.001, 0.0001)
    """
    if isinstance(like, tuple):
        pair = value.tolist() if isinstance(value, np.ndarray) else value
        if not (isinstance(pair, list | tuple) and len(pair) == 2 and all(map(_is_number, pair))):
            raise InputError(f'{name} takes two numbers, first and last, such as {like}, not {shown(value)}')
        return tuple(map(_plain, pair))
    if isinstance(like, bool):
        good, kind = isinstance(value, bool | np.bool_), 'True or False'
    elif isinstance(like, int):
        good, kind = _is_number(value) and _is_whole(value), 'a whole number'
        value = int(value) if good else value
    elif isinstance(like, float):
        good, kind = _is_number(value), 'a number'
    else:
        good, kind = isinstance(value, str), 'text'
    if not good:
        raise InputError(f'{name} must be {kind}, not {shown(value)}')
    return _plain(value)


def whole_number(name: str, value: Any, least: int) -> int:
    """A whole number from `least` on. Raises InputError, in the name of `name`."""
    try:
        number = operator.index(value)
    except TypeError:
        number = least - 1
    if number < least or isinstance(value, bool):
        raise InputError(f'{name} must be a whole number from {least} on, not {shown(value)}')
    return number


def seed(value: Any, name: str = 'seed') -> int:
    """A seed that every generator of random numbers takes. Raises InputError, in the name of `name`."""
    number = whole_number(name, value, 0)
    if number > MOST_SEED:
        raise InputError(f'{name} must be at most {MOST_SEED}, not {shown(value)}')
    return number


def require_ranges(part: Any, **ranges: tuple[float, float]) -> None:
    """Raises InputError unless the fields of a dataclass that have a default are of its kind, and every number in its range.
    Fields that are dataclasses check themselves.

    Parameters
    ----------
    ranges : tuple[float, float]
        (least, most), both of them allowed, of every such field that holds a number or two.

    Examples
    --------
    >>> require_ranges(self, iterations=(1, 1e9), rate=(0, 1))
    """
    for f in (f for f in fields(part) if not (f.default is MISSING or is_dataclass(f.default))):
        value = checked(f.name, getattr(part, f.name), f.default)
        if isinstance(value, bool | str):
            continue
        least, most = ranges[f.name]
        if not all(least <= x <= most for x in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f'{f.name} must lie in [{least:g}, {most:g}], not {shown(value)}')


def nearest(name: str, names: Iterable[str]) -> str:
    """', did you mean ...?' with the nearest of the names to a misspelt one, for messages; empty if none is near."""
    near = difflib.get_close_matches(name, list(names), 1)
    return f', did you mean {near[0]}?' if near else ''


def _is_number(value):
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)


def _is_whole(value):
    return isinstance(value, int) or bool(math.isfinite(value) and value == int(value))


def _plain(value):
    return value.item() if isinstance(value, np.generic) else value
