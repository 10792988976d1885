"""Values of settings and parameters from the text of a command line."""

from __future__ import annotations

from typing import Any

from lingo_mi.errors import InputError


def parse(name: str, text: str, like: Any) -> Any:
    """The value that `text` says, of the kind of `like`: text, true or false, a whole number, a number, or two numbers, of
    which one stands for both.

    Raises InputError, in the name of `name`.
    """
    try:
        if isinstance(like, tuple):
            numbers = tuple(float(x) for x in text.split(','))
            return numbers * 2 if len(numbers) == 1 else numbers
        if isinstance(like, bool):
            return {'true': True, 'false': False}[text.lower()]
        if isinstance(like, int) and float(text) != int(float(text)):
            raise ValueError
        return int(float(text)) if isinstance(like, int) else type(like)(text)
    except (ValueError, KeyError, OverflowError):
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', tuple: 'two numbers, first,last'}[
            type(like)
        ]
        raise InputError(f'{name} must be {kind}, not {text!r}') from None
