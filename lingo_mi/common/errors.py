"""The one exception for input that a user can correct, and the one warning of numbers that are less accurate than promised."""

LONGEST = 299  # characters of a message that a command prints


def printable(text: object) -> str:
    """A text on one line, with control characters as escapes."""
    line = ' '.join(str(text).split())
    return ''.join(c if c.isprintable() else c.encode('unicode_escape').decode() for c in line)


def brief(text: object, longest: int = LONGEST) -> str:
    """A `printable` text, its middle left out if it is longer than `longest`.

    The name stays at the start and the remedy at the end, even if a file's text stands between them.
    """
    text = str(text)
    if len(text) > 4 * longest:  # shorten it before every character is examined
        text = text[: 2 * longest] + text[-2 * longest :]
    line = printable(text)
    if len(line) <= longest:
        return line
    end = longest // 3
    return f'{line[: longest - end - 3]} … {line[-end:]}'


def shown(value: object) -> str:
    """The start of a value's repr, for messages that quote what a file says; its type if it has none."""
    try:
        text = repr(value)
    except (ValueError, RecursionError, MemoryError):  # an integer of too many digits
        return f'that {type(value).__name__}'
    return text if len(text) <= 80 else text[:77] + '...'


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what is wrong, where, and how to correct it.

    It names Python's arguments, as in `force=True`. Commands print it in less than 300 characters, with their options instead
    (see `lingo_mi.cli.common.guard`), and exit with code 2.

    Examples
    --------
    >>> try:
    ...     raise InputError("angles: 3 angles for 4 views; give one for each view")
    ... except InputError as error:
    ...     print(error)
    angles: 3 angles for 4 views; give one for each view
    """

    def __init__(self, message: object = ''):
        super().__init__(printable(message))


class AccuracyWarning(UserWarning):
    """Warns that float32 gives this result with fewer digits than usual. The message says why, and how many digits are left."""


def require_type(name: str, value: object, kinds: type | tuple[type, ...], remedy: str = '') -> None:
    """Raise InputError unless `value` is an instance of one of `kinds`.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    remedy : str
        Remedy, for the message.

    Examples
    --------
    >>> require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
    """
    if not isinstance(value, kinds):
        wanted = ' or '.join(f'a {kind.__name__}' for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
        raise InputError(f'{name} must be {wanted}, not {type(value).__name__}' + (f'; {remedy}' if remedy else ''))
