"""One writer at a time: a lock file that names its owner, and that a killed process does not leave locked.

filelock names no owner, takes a user's file of that name for its lock, and fails if the system answers that it does not
support locks.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil

from lingo_mi.common.errors import InputError, shown
from lingo_mi.storage.file_access import leftovers, writing

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = '.lingo_mi.lock'


@contextmanager
def locked(folder: Path | str, name: str = LOCK) -> Iterator[None]:
    """Holds the lock of a folder, which is made if missing; folders that were made and are left empty are removed again.

    The system gives the lock back when its owner ends, however that ends. If the file system has no such locks, the file
    itself is the lock, and the lock of a dead process of this computer is taken over.

    Parameters
    ----------
    name : str
        Name of the lock file, another one if the folder holds files of several processes.

    Raises
    ------
    InputError
        If another process has it.
    """
    folder = Path(folder)
    with ExitStack() as stack, writing(folder):
        for part in (*reversed(folder.parents), folder):
            if not part.exists():
                part.mkdir(exist_ok=True)
                stack.callback(_remove_empty, part)
        _take(folder / name, stack)
        inner = stack.pop_all()
    with inner:
        yield


@contextmanager
def writing_file(path: Path) -> Iterator[None]:
    """Keeps other processes from writing this output file; what a killed one has left of it is removed."""
    with locked(path.parent, f'{LOCK}-{path.name[-40:]}'):
        for leftover, target in leftovers(path.parent):
            if target == path.name[-40:]:
                leftover.unlink(missing_ok=True)
        for leftover, target in leftovers(path.parent, folders=True):
            if target == path.name[-40:]:
                shutil.rmtree(leftover, ignore_errors=True)
        yield


def _take(path: Path, stack: ExitStack) -> None:
    """Take the lock; the stack gives it back."""
    while True:
        file, created = _open(path)
        with ExitStack() as failed:
            failed.callback(os.close, file)
            held = _hold(file)
            owner = _owner(file)
            if held is False or held is None and not created and _alive(owner):
                raise _refusal(path, owner, held is None)
            if not _same(path, file):
                continue  # its owner has removed it meanwhile
            failed.callback(path.unlink, missing_ok=True)
            _name_owner(file)
            failed.pop_all()
        stack.callback(_give_back, path, file)
        return


def _hold(file: int) -> bool | None:
    """Return whether the system gives this process the lock; None if it has no such locks."""
    try:
        if fcntl is None:
            return None
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _open(path: Path) -> tuple[int, bool]:
    """The lock file, and whether it is new. A link is not followed."""
    flags = os.O_RDWR | getattr(os, 'O_NOFOLLOW', 0)
    try:
        return os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644), True
    except FileExistsError:
        if path.is_symlink() or not path.is_file():
            raise InputError(f'{path}: is not a lock of lingo_mi; move it away, or choose another place') from None
        return os.open(path, flags | os.O_CREAT, 0o644), False


def _same(path: Path, file: int) -> bool:
    """Return whether the open file still has this name."""
    try:
        return os.path.samestat(os.lstat(path), os.fstat(file))
    except FileNotFoundError:
        return False


def _name_owner(file: int) -> None:
    os.ftruncate(file, 0)
    os.lseek(file, 0, os.SEEK_SET)
    os.write(file, json.dumps(dict(pid=os.getpid(), host=socket.gethostname())).encode())


def _owner(file: int) -> dict:
    """Return the process that wrote the lock file; raise InputError if it is another program's file."""
    os.lseek(file, 0, os.SEEK_SET)
    content = os.read(file, 4096)
    if not content:  # just made, or its owner was killed then
        return {}
    try:
        owner = json.loads(content)
        return dict(pid=int(owner['pid']), host=str(owner['host']))
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f'a file {LOCK} holds {shown(content[:20])}, so it is not a lock of lingo_mi; move it away'
        ) from None


def _alive(owner: dict) -> bool:
    """Return whether the owner may still be running. This is known only for processes of this computer."""
    if not owner or owner['host'] != socket.gethostname():
        return True
    try:
        return psutil.pid_exists(owner['pid'])
    except OverflowError:  # not the number of a process
        return False


def _refusal(path: Path, owner: dict, lasting: bool) -> InputError:
    """The error; lasting: the lock stays when its owner is killed."""
    who = f'process {owner["pid"]} on {shown(owner["host"])}' if owner else 'another process'
    remedy = 'wait for it, or choose another place'
    if lasting:
        remedy += f'; if it has ended, remove {path.name}'
    return InputError(f'{path.parent}: {who} is writing there; {remedy}')


def _give_back(path: Path, file: int) -> None:
    try:
        if fcntl is None:
            os.close(file)
            path.unlink()
        else:  # removed while it is still held: nobody else can have it then
            path.unlink()
            os.close(file)
    except OSError:  # it is no longer locked in any case
        pass


def _remove_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError:  # it holds files
        pass
