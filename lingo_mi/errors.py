"""The one exception for input that a user can mend."""


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what is wrong, where, and how to mend it.

    Scripts print it and exit with code 2 (see `lingo_mi.cli.guard`).
    """
