"""Opening and replacing files: one clear line for whatever the file system refuses, and never half a file."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

from lingo_mi.common.errors import InputError, shown


def one_line(error: BaseException | str) -> str:
    """The message of an exception, or a text, on one line, without its trailing full stop."""
    return ' '.join(str(error).split()).rstrip('.') or type(error).__name__


@contextmanager
def reading(path: PathLike | str, folder: bool = False) -> Iterator[None]:
    """Turns what the file system says about `path` while it is read into an InputError.

    Parameters
    ----------
    folder : bool
        Whether it must be a folder; else it must be a regular file: a device has no end, and a pipe may never begin.
    """
    try:
        try:
            kind = os.stat(path).st_mode
        except ValueError:  # a zero byte, or text that is not a file name
            raise InputError(f'{path}: is not a name of a file; correct it') from None
        if folder != stat.S_ISDIR(kind):
            what = 'a file, not a folder' if folder else 'a folder, not a file'
            raise InputError(f'{path}: cannot be read (it is {what}); check the path')
        if not folder and not stat.S_ISREG(kind):
            raise InputError(f'{path}: cannot be read (it is a device or a pipe); give a regular file')
        yield
    except FileNotFoundError as error:
        raise InputError(f'{error.filename or path}: there is no such file; check the path') from None
    except OSError as error:
        if error.errno is None:  # raised by a format, not by the system
            raise InputError(f'{path}: is damaged ({one_line(error)}); fetch it or write it again') from None
        raise InputError(
            f'{error.filename or path}: cannot be read ({error.strerror}); check the path and its permissions'
        ) from None


# What a kill may leave behind. The suffix stays at the end because several libraries choose the format by it.
_TEMPORARY = '.lingo_mi-{}-{}'
_LEFTOVER = re.compile(r'\.lingo_mi-[0-9a-f]{16}-(.*)', re.DOTALL)


def parsed_json(text: str | bytes) -> Any:
    """Parse a text in JSON.

    Raises
    ------
    ValueError
        For any other text, also for one that is nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError('nested too deeply') from None


def read_json(path: PathLike | str) -> Any:
    """Read a JSON file; return None if it is not JSON.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with reading(path):
        text = Path(path).read_bytes()
    try:
        return parsed_json(text)
    except ValueError:
        return None


def read_object(path: PathLike | str) -> dict[str, Any]:
    """Read the object in a JSON file.

    Raises
    ------
    InputError
        If it cannot be read or holds something else.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f'{path}: is damaged; remove it, to make it again')
    return content


@contextmanager
def _temporary(path, make, remove):
    path = Path(path)
    temporary = path.with_name(_TEMPORARY.format(secrets.token_hex(8), path.name[-40:]))
    try:
        make(temporary)
        yield temporary
        flush(temporary)
        take_place(temporary, path)
        flush_folder(path.parent)
    except OSError as error:
        raise InputError(
            f'{path}: cannot be written ({error.strerror or one_line(error)}); '
            'check that the folder exists, may be written to, and has room'
        ) from None
    finally:
        remove(temporary)


_WINDOWS = sys.platform == 'win32'


def take_place(temporary: Path, path: Path) -> None:
    """Give a file or folder its name.

    Windows refuses a name that an empty folder has, and the name of a file while another program reads it.
    """
    if _WINDOWS:
        if path.is_dir():
            path.rmdir()
        for seconds in 0.01, 0.03, 0.1, 0.3, 1.0:
            try:
                os.replace(temporary, path)
                return
            except PermissionError:
                time.sleep(seconds)
    os.replace(temporary, path)


def _new_file(path):
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))


def _remove_file(path):
    try:
        path.unlink()
    except OSError:  # renamed away, or never made
        pass


def flush(path: Path) -> None:
    """Wait until a file, or all files in a folder, are on the disk: a name must never come before its content."""
    if path.is_dir():
        for part in path.iterdir():
            flush(part)
        flush_folder(path)
        return
    file = os.open(path, os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def flush_folder(path: PathLike | str) -> None:
    """Wait until the names in a folder are on the disk, if the system can."""
    if not hasattr(os, 'O_DIRECTORY'):
        return
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):  # some file systems cannot do it
            raise
    finally:
        os.close(folder)


@contextmanager
def replacing(path: PathLike | str) -> Iterator[Path]:
    """Yields a new, empty file beside `path`, which takes its place when the block ends without an error.

    Its content is on the disk before it has its name, so that `path` is the old file or the new one also after a crash. If
    `path` is a link, the link is replaced, not what it points to.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with _temporary(path, _new_file, _remove_file) as temporary:
        yield temporary


def leftovers(folder: Path, folders: bool = False) -> list[tuple[Path, str]]:
    """Files in a folder that a killed process of ours has left behind, and the names that they were to get (their ends).

    Parameters
    ----------
    folders : bool
        Its folders instead.
    """
    matches = [(path, _LEFTOVER.fullmatch(path.name)) for path in folder.iterdir()]
    kind = Path.is_dir if folders else Path.is_file
    return [(path, match[1]) for path, match in matches if match and kind(path) and not path.is_symlink()]


def write_text(path: PathLike | str, text: str) -> None:
    """Write a text file as UTF-8, whole or not at all; characters that have no UTF-8 are escaped.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode('utf-8', 'backslashreplace'))


@contextmanager
def new_folder(path: PathLike | str) -> Iterator[Path]:
    """Yields a temporary folder, which becomes `path` when the block ends without an error.

    Raises
    ------
    InputError
        If `path` exists and is not an empty folder, or cannot be written.
    """
    path = Path(path)
    require_new_folder(path)
    with _temporary(path, Path.mkdir, lambda folder: shutil.rmtree(folder, ignore_errors=True)) as temporary:
        yield temporary


def require_new_folder(path: Path) -> None:
    """Raises InputError if `path` exists and is not an empty folder."""
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f'{path}: exists already; remove it or give another name')


def new_file(path: Path, force: bool) -> None:
    """Makes the folder of a file to be written.

    Raises
    ------
    InputError
        If the file exists, unless `force` replaces it.
    """
    if path.exists() and not force:
        raise InputError(f'{path}: exists already; give force=True to replace it')
    path.parent.mkdir(parents=True, exist_ok=True)


def check_new_file(path: Path, force: bool) -> None:
    """Raises InputError if a file cannot be written, or would replace a folder, a link or, unless `force`, a file.

    Leaves nothing behind.
    """
    if path.is_dir():
        raise InputError(f'{path}: is a folder; give another name')
    if path.is_symlink():
        raise InputError(f'{path}: is a link, which is not written to; give another name')
    if path.exists() and not force:
        raise InputError(f'{path}: exists already; give force=True to replace it')
    require_writable(path.parent, path)


@contextmanager
def writing(path: PathLike | str) -> Iterator[None]:
    """Turns what the file system says about `path` while files are written there into an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f'{error.filename or path}: cannot be written ({error.strerror or one_line(error)}); choose another place'
        ) from None


def require_writable(folder: Path, path: Path, remedy: str = 'choose another place') -> None:
    """Raises InputError, in the name of `path`, unless `folder` can be made and written to. Leaves nothing behind.

    Parameters
    ----------
    remedy : str
        Remedy, for the message.
    """
    try:
        with tempfile.TemporaryFile(dir=_deepest(folder)):  # of a name that no file has
            pass
    except OSError as error:
        raise InputError(f'{path}: cannot write there ({error.strerror}); {remedy}') from None


def _deepest(folder: Path) -> Path:
    """The folder itself, or of those above it the first that exists. Nothing is made: another process may be about to."""
    while True:
        try:
            os.lstat(folder)
            return folder
        except FileNotFoundError:
            folder = folder.parent


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

    Raises
    ------
    InputError
        For any other: what a stranger's file names is not looked for in the rest of the system.
    """
    path = Path(name) if isinstance(name, str) else None
    if path is None or not name or path.is_absolute() or path.drive or '..' in path.parts:
        raise InputError(
            f'{file}: names the file {shown(name)}; give the name of one beside it or in a folder below, without ..'
        )
    return Path(file).parent / path


def as_path(name: str, value: Any) -> Path:
    """`value` as a path. Raises InputError, in the name of `name`, if it is not a path."""
    try:
        return Path(value)
    except TypeError:
        raise InputError(f'{name} must be a path, not {type(value).__name__}') from None


def optional(module: str, extra: str = 'formats') -> Any:
    """Imports a package of an extra.

    Raises
    ------
    InputError
        With the command that installs it.
    """
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"this format needs the package {module.partition('.')[0]}: pip install '.[{extra}]' in a checkout of lingo_mi"
        ) from None
