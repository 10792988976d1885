"""The folder of a result: which files in it are ours, and whether they belong together.

`.lingo_mi.json`, the manifest, names the files that this program has written there, or was about to write: no other is ever
replaced or removed. `metrics.json` marks a whole result. It holds a digest of every other file, is removed before any of them
is changed, and is written last.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import (
    flush_folder,
    leftovers,
    read_json,
    reading,
    replacing,
    require_writable,
    writing,
)
from lingo_mi.storage.folder_lock import LOCK

METRICS, CHECKPOINT, MANIFEST, VIEWS = 'metrics.json', 'checkpoint.npz', '.lingo_mi.json', 'views'
VOLUME, CLOUD, SCENE, PICTURE, PAGE = 'volume.nii.gz', 'gaussians.ply', 'result.xml', 'report.png', 'report.html'
FILES = VOLUME, CLOUD, SCENE, PICTURE, PAGE, METRICS, CHECKPOINT
_VIEW = re.compile(rf'{VIEWS}/\d{{4,}}\.exr')


@dataclass(frozen=True)
class Manifest:
    """files: names that are ours; writing: whether a result was begun and not completed."""

    files: frozenset[str] = frozenset()
    writing: bool = False


def view_name(index: int) -> str:
    """The name of the image of a held-out view."""
    return f'{VIEWS}/{index:04d}.exr'


def manifest_of(folder: Path) -> Manifest:
    """The manifest of a folder.

    Raises
    ------
    InputError
        If it is not a manifest.
    """
    path = folder / MANIFEST
    if not os.path.lexists(path):
        return Manifest()
    _require_file(path)
    content = read_json(path)
    names, begun = (content.get('files'), content.get('writing')) if isinstance(content, dict) else (None, None)
    if not (isinstance(names, list) and isinstance(begun, bool) and all(isinstance(n, str) for n in names)):
        raise InputError(f'{path}: is not a manifest of lingo_mi; move it away, or choose another folder')
    return Manifest(frozenset(n for n in names if _is_name(n)), begun)


def require_ours(folder: Path, names: Iterable[str]) -> None:
    """Raises InputError if one of the names is of a file in the folder that this program has not written, or of a link."""
    if os.path.lexists(folder / VIEWS) and ((folder / VIEWS).is_symlink() or not (folder / VIEWS).is_dir()):
        raise InputError(f'{folder / VIEWS}: is a link or a file, not a folder; move it away, or choose another folder')
    ours = manifest_of(folder).files
    for name in sorted(names):
        path = folder / name
        if os.path.lexists(path):
            _require_file(path)
            if name not in ours:
                raise InputError(f'{path}: was not written by lingo_mi; move it away, or choose another folder')


def begin(folder: Path, names: Iterable[str]) -> None:
    """To be called before files of a result are changed: they become ours, and an old result in the folder is marked incomplete.

    Raises
    ------
    InputError
        As `require_ours`, before anything is changed.
    """
    names, manifest = frozenset(names), manifest_of(folder)
    require_ours(folder, names | manifest.files & {METRICS})
    now = Manifest(manifest.files | names, True)
    if now != manifest:
        _write(folder, now)
    path = folder / METRICS
    if METRICS in manifest.files and path.exists():
        with writing(folder):
            path.unlink()
            flush_folder(folder)


def remove_others(folder: Path, names: Iterable[str]) -> None:
    """Remove the files of an earlier result that are not of these names."""
    with writing(folder):
        for name in manifest_of(folder).files.difference(names):
            if not (folder / name).is_symlink():
                (folder / name).unlink(missing_ok=True)
        views = folder / VIEWS
        if views.is_dir() and not views.is_symlink() and not any(views.iterdir()):
            views.rmdir()


def complete_result(folder: Path, names: Iterable[str], numbers: dict, default: Callable | None = None) -> dict:
    """Write metrics.json, which marks the existing files of these as a whole result.

    Parameters
    ----------
    default : Callable or None
        As for `json.dumps`.

    Returns
    -------
    dict
        The numbers as written, with `files`, the digests.
    """
    there = [name for name in sorted(names) if (folder / name).exists()]
    numbers = numbers | dict(files={name: digest(folder / name) for name in there})
    with replacing(folder / METRICS) as temporary:
        temporary.write_text(json.dumps(numbers, indent=1, default=default) + '\n', encoding='utf-8')
    _write(folder, Manifest(frozenset(numbers['files']) | {METRICS}))
    return numbers


def digest(path: Path) -> str:
    """A digest of a file's content."""
    hasher = hashlib.blake2b(digest_size=32)
    with reading(path), open(path, 'rb') as file:
        while part := file.read(1 << 20):
            hasher.update(part)
    return f'blake2b:{hasher.hexdigest()}'


def require_together(folder: Path, names: Iterable[str]) -> None:
    """Raises InputError if files of these names in a folder are not of one result.

    They are not if metrics.json has other digests of them, or if a result was begun and not completed. Files that were copied
    from their folder are not checked.
    """
    path = folder / METRICS
    if not path.exists():
        manifest = manifest_of(folder)
        if manifest.writing and any(name in manifest.files and (folder / name).exists() for name in names):
            raise InputError(f'{folder}: a result was not completed here; resume the fit, or fit again')
        return
    record = read_json(path)
    digests = record.get('files') if isinstance(record, dict) else None
    if not isinstance(digests, dict):
        return
    for name in names:
        file = folder / name
        if name in digests and file.exists() and digest(file) != digests[name]:
            raise InputError(f'{file}: does not match {METRICS} beside it; fit again')


def occupants(folder: Path) -> list[str]:
    """Names in a folder, without what a killed process of ours has left behind."""
    passed_over = {MANIFEST, LOCK, *(path.name for path in _leftovers(folder))}
    return sorted(path.name for path in folder.iterdir() if path.name not in passed_over)


def result_folder(path: Path, *, force: bool = False, resume: bool = False) -> Path:
    """The folder of a result, which can be made and written to. Leaves nothing behind.

    Parameters
    ----------
    force, resume : bool
        Whether a folder with files in it will do.

    Raises
    ------
    InputError
        Rather than spoil what is there.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f'{path}: is a file, not a folder; choose another folder')
    there = occupants(path) if path.is_dir() else []
    if resume and CHECKPOINT not in there:
        instead = 'run without resume=True' + (', with force=True' if there else '')
        raise InputError(f'{path / CHECKPOINT}: there is no checkpoint to go on from; {instead}')
    if there and not (force or resume):
        what, way = 'is not empty', 'force=True to write beside what is there'
        if METRICS in there:
            what, way = 'holds a result already', 'force=True to replace it'
        if CHECKPOINT in there:
            what = what if METRICS in there else 'holds a fit that was not completed'
            way = 'resume=True to go on, force=True to replace it'
        raise InputError(f'{path}: {what}; give {way}, or choose another folder')
    require_writable(path, path, 'choose another folder')
    if path.is_dir():
        require_ours(path, FILES)
    return path


def clear_leftovers(folder: Path) -> None:
    """Remove what killed processes of ours have left behind; only to be called by one that holds the folder's lock."""
    with writing(folder):
        for path in _leftovers(folder):
            path.unlink(missing_ok=True)


def _leftovers(folder: Path) -> list[Path]:
    """Files of a result that never got their names."""
    files = [path for path, target in leftovers(folder) if target == MANIFEST or _is_name(target)]
    views = folder / VIEWS
    if views.is_dir() and not views.is_symlink():
        files += [path for path, target in leftovers(views) if _is_name(f'{VIEWS}/{target}')]
    return files


def _is_name(name: str) -> bool:
    return name in FILES or _VIEW.fullmatch(name) is not None


def _require_file(path: Path) -> None:
    if path.is_symlink() or not path.is_file():
        raise InputError(
            f'{path}: is a link or a folder, which is not written to; move it away, or choose another folder'
        )


def _write(folder: Path, manifest: Manifest) -> None:
    with replacing(folder / MANIFEST) as temporary:
        content = dict(files=sorted(manifest.files), writing=manifest.writing)
        temporary.write_text(json.dumps(content, indent=1) + '\n', encoding='utf-8')
