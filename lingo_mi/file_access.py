"""Opening and replacing files: one clear line for whatever the file system refuses, and never half a file."""

from __future__ import annotations

import logging
import os
import shutil
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

from lingo_mi.errors import InputError, shown


def one_line(error: BaseException | str) -> str:
    """The message of an exception, or a text, on one line, without its trailing full stop."""
    return ' '.join(str(error).split()).rstrip('.') or type(error).__name__


@contextmanager
def reading(path: PathLike | str, folder: bool = False) -> Iterator[None]:
    """Turns what the file system says about `path` while it is read into an InputError.

    folder   whether it must be a folder; else it must be a regular file: a device has no end, and a pipe may never begin
    """
    try:
        try:
            kind = os.stat(path).st_mode
        except ValueError:  # a zero byte, or text that is no file name
            raise InputError(f'{path}: is no name of a file; correct it') from None
        if folder != stat.S_ISDIR(kind):
            what = 'a file, not a folder' if folder else 'a folder, not a file'
            raise InputError(f'{path}: cannot be read (it is {what}); check the path')
        if not folder and not stat.S_ISREG(kind):
            raise InputError(f'{path}: cannot be read (it is a device or a pipe); give a regular file')
        yield
    except FileNotFoundError as error:
        raise InputError(f'{error.filename or path}: there is no such file; check the path') from None
    except OSError as error:
        if error.errno is None:  # not the system's, but a format's
            raise InputError(f'{path}: is damaged ({one_line(error)}); fetch it or write it again') from None
        raise InputError(
            f'{error.filename or path}: cannot be read ({error.strerror}); check the path and its permissions'
        ) from None


@contextmanager
def _temporary(path, remove):
    path = Path(path)
    # The suffix stays at the end because several libraries choose the format by it.
    temporary = path.with_name(f'.{os.getpid()}.{path.name}')
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f'{path}: cannot be written ({error.strerror or one_line(error)}); '
            'check that the folder exists and may be written to'
        ) from None
    finally:
        remove(temporary)


def _remove_file(path):
    try:
        path.unlink()
    except OSError:  # renamed away, or never made
        pass


@contextmanager
def replacing(path: PathLike | str) -> Iterator[Path]:
    """Yields a temporary path beside `path`, which takes its place when the block ends without an error.

    Raises InputError if the file cannot be written.
    """
    with _temporary(path, _remove_file) as temporary:
        yield temporary


@contextmanager
def new_folder(path: PathLike | str) -> Iterator[Path]:
    """Yields a temporary folder, which becomes `path` when the block ends without an error.

    Raises InputError if `path` exists and is not an empty folder, or cannot be written.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f'{path}: exists already; remove it or give another name')
    with _temporary(path, lambda folder: shutil.rmtree(folder, ignore_errors=True)) as temporary:
        temporary.mkdir()
        yield temporary


@contextmanager
def writing(path: PathLike | str) -> Iterator[None]:
    """Turns what the file system says about `path` while files are written there into an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f'{error.filename or path}: cannot be written ({error.strerror or one_line(error)}); choose another place'
        ) from None


def require_writable(folder: Path, path: Path, mend: str = 'choose another place') -> None:
    """Raises InputError, in the name of `path`, unless `folder` can be made and written to. Leaves nothing behind.

    mend   what to do, for the message
    """
    made = []
    try:
        for part in (*reversed(folder.parents), folder):
            if not part.exists():
                part.mkdir()
                made.append(part)
        probe = folder / '.writable'
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f'{path}: cannot write there ({error.strerror}); {mend}') from None
    finally:
        for part in reversed(made):
            part.rmdir()


@contextmanager
def quiet(library: str) -> Iterator[None]:
    """Holds back what a library logs of a file and warns of: what matters of it is in the InputError."""
    logger = logging.getLogger(library)
    before, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            yield
    finally:
        logger.disabled = before


def beside(file: PathLike | str, name: Any) -> Path:
    """The path of a file that `file` names, which lies beside it or in a folder below.

    Raises InputError for any other: what a stranger's file names is not looked for in the rest of the system.
    """
    path = Path(name) if isinstance(name, str) else None
    if path is None or not name or path.is_absolute() or path.drive or '..' in path.parts:
        raise InputError(
            f'{file}: names the file {shown(name)}; give the name of one beside it or in a folder below, without ..'
        )
    return Path(file).parent / path


def as_path(name: str, value: Any) -> Path:
    """`value` as a path. Raises InputError, in the name of `name`, where it is none."""
    try:
        return Path(value)
    except TypeError:
        raise InputError(f'{name} must be a path, not {type(value).__name__}') from None


def optional(module: str) -> Any:
    """Imports a package of the `formats` extra. Raises InputError with the command that installs it."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"this format needs the package {module}: pip install '.[formats]' in a checkout of lingo_mi"
        ) from None
