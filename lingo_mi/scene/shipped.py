"""The scenes that come with the package, by name."""

from __future__ import annotations

import os
from importlib import resources
from os import PathLike
from pathlib import Path

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import nearest


def scenes() -> dict[str, Path]:
    """Path of every shipped scene by name, such as 'x3d_foot' or 'effects/psf'."""
    root = Path(str(resources.files('lingo_mi.scenes')))
    return {path.relative_to(root).with_suffix('').as_posix(): path for path in sorted(root.rglob('*.xml'))}


def scene_path(scene: PathLike | str) -> Path:
    """The file of a scene: `scene` itself if it is a file, else the shipped scene of that name.

    Folders do not count: a result folder `x3d_foot` does not hide the scene of that name.

    Raises
    ------
    InputError
        If there is neither. A folder of another name is returned unchanged; reading it fails later.
    """
    path = Path(scene)
    if os.path.isfile(path):  # unlike Path's method, this is False for a name that is too long
        return path
    shipped = scenes()
    if str(scene) in shipped:
        return shipped[str(scene)]
    if os.path.exists(path):
        return path
    name = str(scene)[:100]
    raise InputError(
        f'{name}: there is no such scene{nearest(name, shipped)}; name a file, or one of {", ".join(sorted(shipped))}'
    )
