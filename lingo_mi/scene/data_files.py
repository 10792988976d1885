"""Locations of the data files that a scene names."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mitsuba as mi

from lingo_mi.common.errors import InputError


def data_file(name: str, parameter: str) -> str:
    """The path of a file that a scene names: next to the scene or in the working folder, else in the folder LINGO_MI_DATA.

    Parameters
    ----------
    parameter : str
        The scene's `<default>` that sets the file, for the message.

    Raises
    ------
    InputError
        In one line, if there is no such file, or if it is a device or a pipe, which may have no end.
    """
    resolver: Any = mi.file_resolver  # declared as an object
    path = Path(str(resolver().resolve(name)))
    folder = os.environ.get('LINGO_MI_DATA')
    if not os.path.exists(path) and folder:  # unlike Path's method, this is False for a name that is too long
        path = Path(folder) / name
    if not os.path.exists(path):
        where = f'nor in LINGO_MI_DATA = {folder}' if folder else 'and LINGO_MI_DATA is not set'
        raise InputError(
            f'{name[:100]}: there is no such file beside the scene, {where}; set LINGO_MI_DATA to the folder '
            f'that holds it, or name your file: {parameter}=FILE'
        )
    if not path.is_file() and not path.is_dir():
        raise InputError(f'{name}: is not a regular file, but a device or a pipe; name another: {parameter}=FILE')
    return str(path)
