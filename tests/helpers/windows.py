"""Windows' rules for files, as far as Linux can keep them in this process.

A file that is open or mapped is neither renamed, replaced nor removed; no folder is replaced; there is no `fcntl`.
"""

import errno
import os
from pathlib import Path

from lingo_mi.storage import file_access, folder_lock


def in_use(path):
    """Return whether this process has the file, or a file in the folder, open or mapped."""
    path = os.path.realpath(path)
    lines = Path('/proc/self/maps').read_text(encoding='utf-8').splitlines()
    names = {line.split(maxsplit=5)[-1] for line in lines}
    for number in os.listdir('/proc/self/fd'):
        try:
            names.add(os.readlink(f'/proc/self/fd/{number}'))
        except FileNotFoundError:  # the descriptor of the list itself
            pass
    return any(name == path or name.startswith(path + os.sep) for name in names)


def install(monkeypatch):
    """Keep these rules for one test."""

    def refusing(original, refused):
        def call(*paths, **options):
            if refused(*paths):
                raise PermissionError(errno.EACCES, 'Access is denied', str(paths[0]))
            return original(*paths, **options)

        return call

    for name in 'replace', 'rename':
        original = getattr(os, name)
        monkeypatch.setattr(os, name, refusing(original, lambda a, b: os.path.isdir(b) or in_use(a) or in_use(b)))
    for name in 'unlink', 'remove':
        monkeypatch.setattr(
            os, name, refusing(getattr(os, name), lambda path: not os.path.islink(path) and in_use(path))
        )
    monkeypatch.setattr(file_access, '_WINDOWS', True)
    monkeypatch.setattr(folder_lock, 'fcntl', None)
