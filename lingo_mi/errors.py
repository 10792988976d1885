"""The one exception for input that a user can mend, and the one warning of numbers that are not as good as promised."""


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what is wrong, where, and how to mend it.

    Scripts print it and exit with code 2 (see `lingo_mi.cli.common.guard`).
    """


class AccuracyWarning(UserWarning):
    """Float32 cannot give this result to the usual digits. The message says why, and about how many are left."""


def require_type(name: str, value: object, kinds: type | tuple[type, ...], mend: str = '') -> None:
    """Raises InputError unless `value` is of one of `kinds`.

    name   of the argument, for the message
    mend   what to do, for the message

        require_type('geometry', geometry, Geometry, 'of a scan give scan.geometry')
    """
    if not isinstance(value, kinds):
        wanted = ' or '.join(f'a {kind.__name__}' for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
        raise InputError(f'{name} must be {wanted}, not {type(value).__name__}' + (f'; {mend}' if mend else ''))
