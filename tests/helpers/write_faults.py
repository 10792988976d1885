"""Faults at the n-th call that writes below a folder: the process is killed, the disk is full, or may not be written to.

Python's own calls are counted: opening for writing, each write of a file object, fsync, rename, unlink, mkdir, rmdir, ftruncate.
What a library in C writes to a file counts by the calls before and after it.
"""

import builtins
import errno
import io
import os
import signal

ERRORS = dict(full=errno.ENOSPC, denied=errno.EACCES)
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Faults:
    """Counts calls from `install` on.

    folder   below which calls count
    at       number of the first call that fails; those after it fail as well. None: only count
    kind     'kill', 'full' or 'denied'
    failed   names of the files for which calls have failed
    """

    def __init__(self, folder, at=None, kind='kill'):
        self.folder, self.at, self.kind, self.count = os.fsencode(os.path.realpath(folder)), at, kind, 0
        self.failed = []

    def within(self, path, dir_fd=None):
        """Return whether calls for this path or open file count."""
        try:
            if dir_fd is not None:
                return False
            name = os.readlink(f'/proc/self/fd/{path}') if isinstance(path, int) else os.path.abspath(path)
            parent, base = os.path.split(os.fsencode(name))
            return os.path.join(os.path.realpath(parent), base).startswith(self.folder)
        except OSError:
            return False

    def due(self, path, frees=False):
        """Count a call and return whether it fails. With `frees`, the call needs no room on the disk."""
        if not self.within(path):
            return False
        self.count += 1
        return self.at is not None and self.count >= self.at and not (frees and self.kind == 'full')

    def fail(self, path):
        if self.kind == 'kill':
            os.kill(os.getpid(), signal.SIGKILL)
        name = os.readlink(f'/proc/self/fd/{path}') if isinstance(path, int) else os.fspath(path)
        self.failed.append(os.path.basename(os.fsdecode(name)))
        number = ERRORS[self.kind]
        raise OSError(number, os.strerror(number), None if isinstance(path, int) else path)

    def install(self):
        """Patch this process, from here on and for ever."""
        for name in ('replace', 'rename', 'mkdir', 'fsync', 'ftruncate', 'unlink', 'remove', 'rmdir', 'write', 'link'):
            setattr(os, name, self._wrapped(getattr(os, name), frees=name in ('unlink', 'remove', 'rmdir')))
        system_open = os.open

        def open_(path, flags, mode=0o777, *, dir_fd=None):
            if flags & WRITES and self.within(path, dir_fd) and self.due(path):
                self.fail(path)
            return system_open(path, flags, mode, dir_fd=dir_fd)

        os.open = open_
        builtins.open = io.open = self._opening(io.open)

    def _wrapped(self, original, frees):
        def call(path, *arguments, **options):
            missing = frees and not os.path.lexists(path)  # nothing is written then
            if not missing and options.get('dir_fd') is None and self.due(path, frees):
                self.fail(path)
            return original(path, *arguments, **options)

        return call

    def _opening(self, call):
        faults = self

        class File(io.FileIO):
            def write(self, data):
                if faults.due(self.fileno()):
                    half = memoryview(data).cast('B')
                    super().write(half[: len(half) // 2])
                    faults.fail(self.fileno())
                return super().write(data)

        def open_(file, mode='r', buffering=-1, encoding=None, errors=None, newline=None, closefd=True, opener=None):
            if not {*mode} & {*'wxa+'} or not self.within(file):
                return call(file, mode, buffering, encoding, errors, newline, closefd, opener)
            if self.due(file):
                self.fail(file)
            raw = File(file, mode.replace('b', '').replace('t', ''), closefd, opener)
            if buffering == 0:
                return raw
            stream = (io.BufferedRandom if '+' in mode else io.BufferedWriter)(raw)
            return stream if 'b' in mode else io.TextIOWrapper(stream, encoding, errors, newline)

        return open_
