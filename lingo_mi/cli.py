"""What the command-line scripts share: clear failures, and the arguments of a scene."""
from __future__ import annotations

import sys
from pathlib import Path

from .errors import InputError


def guard(main) -> None:
    """Run a script's main function and exit: 2 with one line for bad input, 130 after Ctrl-C."""
    try:
        sys.exit(main())
    except InputError as error:
        print(f'error: {error}', file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        print(f'error: {error.filename or "file"}: {error.strerror or error}', file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        print(f'interrupted{": " + str(stop) if str(stop) else ""}', file=sys.stderr)
        sys.exit(130)


def definitions(pairs) -> dict[str, str]:
    """The NAME=VALUE arguments of -D as a dictionary."""
    out = {}
    for pair in pairs:
        name, equals, value = pair.partition('=')
        if not equals or not name:
            raise InputError(f'-D {pair}: write it as name=value')
        out[name] = value
    return out


def writable_folder(path: Path, force: bool, resume: bool, owns: str) -> Path:
    """Make the output folder, or refuse to spoil one.

    owns   name of a file that tells an earlier result: with it in place, `force` or `resume` must be given
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f'{path}: is a file, not a folder; choose another --out')
    if path.is_dir() and any(path.iterdir()) and not (force or resume):
        what = 'holds a result already' if (path / owns).exists() else 'is not empty'
        raise InputError(f'{path}: {what}; add --resume to go on, --force to replace it, or choose another --out')
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / '.writable'
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f'{path}: cannot write there ({error.strerror}); choose another --out') from None
    return path
