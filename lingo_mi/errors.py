"""The one exception for input that a user can mend, and the one warning of numbers that are not as good as promised."""


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what is wrong, where, and how to mend it.

    Scripts print it and exit with code 2 (see `lingo_mi.cli.common.guard`).
    """


class AccuracyWarning(UserWarning):
    """Float32 cannot give this result to the usual digits. The message says why, and about how many are left."""
