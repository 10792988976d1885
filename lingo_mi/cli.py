"""What the command-line scripts share: clear failures, Ctrl-C, and the arguments of a scene."""
from __future__ import annotations

import argparse
import os
import signal
import sys
import warnings
from contextlib import contextmanager
from pathlib import Path

from .errors import InputError


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, like any other bad input."""

    def error(self, message):
        self.exit(2, f'error: {message} (see --help)\n')


def guard(main) -> None:
    """Run a script's main function and exit: 2 with one line for bad input, 130 after Ctrl-C.

    Warnings become one line each.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f'warning: {message}', file=sys.stderr)
            sys.exit(main() or 0)
    except InputError as error:
        print(f'error: {error}', file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        print(f'error: {error.filename or "file"}: {error.strerror or error}', file=sys.stderr)
        sys.exit(2)
    except MemoryError as error:
        print(f'error: not enough memory ({error})', file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        print(f'interrupted{": " + str(stop) if str(stop) else ""}', file=sys.stderr)
        sys.exit(130)


@contextmanager
def between_steps():
    """Hold Ctrl-C back: yields a function that raises KeyboardInterrupt if it was pressed since the last call.

    A loop that calls it between its steps is never stopped within one, where its state is half old and half new. A
    second Ctrl-C stops at once.
    """
    pressed = []

    def press(*_):
        if pressed:
            raise KeyboardInterrupt
        pressed.append(True)
        print('\nstopping after this step; Ctrl-C again to stop at once', file=sys.stderr)

    def check():
        if pressed:
            raise KeyboardInterrupt
    before = signal.signal(signal.SIGINT, press)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


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
    """The output folder, which can be made and written to, or an error that refuses to spoil one.

    Leaves nothing behind.

    owns   name of a file that tells an earlier result
    force, resume   whether a folder with files in it will do
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f'{path}: is a file, not a folder; choose another --out')
    if path.is_dir() and any(path.iterdir()) and not (force or resume):
        what = 'holds a result already' if (path / owns).exists() else 'is not empty'
        raise InputError(f'{path}: {what}; add --resume to go on, --force to replace it, or choose another --out')
    made = []
    try:
        for part in (*reversed(path.parents), path):
            if not part.exists():
                part.mkdir()
                made.append(part)
        probe = path / '.writable'
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f'{path}: cannot write there ({error.strerror}); choose another --out') from None
    finally:
        for part in reversed(made):
            part.rmdir()
    return path
