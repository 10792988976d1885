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
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import flush_folder, leftovers, parsed_json, reading, replacing, writing
from lingo_mi.storage.folder_lock import LOCK

METRICS, CHECKPOINT, MANIFEST, VIEWS = 'metrics.json', 'checkpoint.npz', '.lingo_mi.json', 'views'
VOLUME, CLOUD, SCENE, PICTURE, PAGE = 'volume.nii.gz', 'gaussians.ply', 'result.xml', 'report.png', 'report.html'
FILES = VOLUME, CLOUD, SCENE, PICTURE, PAGE, METRICS, CHECKPOINT
_VIEW = re.compile(rf'{VIEWS}/\d{{4,}}\.exr')
_EARLIER = CHECKPOINT + '.partial'  # earlier versions left it behind when they were killed


@dataclass(frozen=True)
class Manifest:
    """files: names that are ours; writing: whether a result was begun and not completed."""

    files: frozenset[str] = frozenset()
    writing: bool = False


def view_name(index: int) -> str:
    """The name of the image of a held-out view."""
    return f'{VIEWS}/{index:04d}.exr'


def manifest_of(folder: Path) -> Manifest:
    """The manifest of a folder; of a result by an earlier version, what it had. Raises InputError where it is no manifest."""
    path = folder / MANIFEST
    if not os.path.lexists(path):
        return Manifest(_earlier_files(folder))
    _require_file(path)
    try:
        with reading(path):
            found = parsed_json(path.read_text(encoding='utf-8'))
        names, begun = found['files'], found['writing']
        if not (isinstance(names, list) and isinstance(begun, bool) and all(isinstance(n, str) for n in names)):
            raise ValueError
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f'{path}: is no manifest of lingo_mi; move it away, or choose another folder') from None
    return Manifest(frozenset(n for n in names if _is_name(n)), begun)


def require_ours(folder: Path, names: Iterable[str]) -> None:
    """Raises InputError where one of the names is of a file in the folder that this program has not written, or of a link."""
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
    """To be called before files of a result are changed: they become ours, and an old result in the folder is whole no longer.

    Raises InputError as `require_ours`, before anything is changed.
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


def complete(folder: Path, names: Iterable[str], numbers: dict, default: Callable | None = None) -> dict:
    """Write metrics.json, which marks a whole result of those of these files that exist.

    Returns the numbers as written, with `files`, the digests.

    default   as of `json.dumps`
    """
    there = [name for name in sorted(names) if (folder / name).exists()]
    numbers = numbers | dict(files={name: digest(folder / name) for name in there})
    with replacing(folder / METRICS) as temporary:
        temporary.write_text(json.dumps(numbers, indent=1, default=default) + '\n', encoding='utf-8')
    _write(folder, Manifest(frozenset(numbers['files']) | {METRICS}))
    return numbers


def digest(path: Path) -> str:
    """A digest of a file's content."""
    found = hashlib.blake2b(digest_size=32)
    with reading(path), open(path, 'rb') as file:
        while part := file.read(1 << 20):
            found.update(part)
    return f'blake2b:{found.hexdigest()}'


def require_together(folder: Path, names: Iterable[str]) -> None:
    """Raises InputError where files of these names in a folder are not of one result.

    That is so where metrics.json has other digests of them, and where a result is begun and not completed. Results of earlier
    versions, and files that were copied from their folder, cannot be told.
    """
    path = folder / METRICS
    if not path.exists():
        manifest = manifest_of(folder)
        if manifest.writing and any(name in manifest.files and (folder / name).exists() for name in names):
            raise InputError(
                f'{folder}: a result was not completed here; go on with lingo-mi fit --resume, or fit again'
            )
        return
    record = _json(path)
    known = record.get('files') if isinstance(record, dict) else None
    if not isinstance(known, dict):
        return
    for name in names:
        file = folder / name
        if name in known and file.exists() and digest(file) != known[name]:
            raise InputError(f'{file}: is not the one that {METRICS} beside it tells of; fit again')


def occupants(folder: Path) -> list[str]:
    """Names in a folder, without what a killed process of ours has left behind."""
    passed_over = {MANIFEST, LOCK, _EARLIER, *(path.name for path in _leftovers(folder))}
    return sorted(path.name for path in folder.iterdir() if path.name not in passed_over)


def clear_leftovers(folder: Path) -> None:
    """Remove what killed processes of ours have left behind; only to be called by one that holds the folder's lock."""
    with writing(folder):
        for path in _leftovers(folder):
            path.unlink(missing_ok=True)


def _leftovers(folder: Path) -> list[Path]:
    """Files of a result that never got their names."""
    found = [path for path, target in leftovers(folder) if target == MANIFEST or _is_name(target)]
    views = folder / VIEWS
    if views.is_dir() and not views.is_symlink():
        found += [path for path, target in leftovers(views) if _is_name(f'{VIEWS}/{target}')]
    return found


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


def _json(path: Path):
    try:
        with reading(path):
            return parsed_json(path.read_text(encoding='utf-8'))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        return None


def _earlier_files(folder: Path) -> frozenset[str]:
    """The files of a result by a version without manifests, which has left metrics.json or a checkpoint that show to be ours."""
    metrics = folder / METRICS
    record = _json(metrics) if metrics.is_file() else None
    versions = record.get('versions') if isinstance(record, dict) else None
    recorded = isinstance(versions, dict) and 'lingo_mi' in versions
    if not (recorded or _is_checkpoint(folder / CHECKPOINT)):
        return frozenset()
    names = {*FILES, *(f'{VIEWS}/{path.name}' for path in (folder / VIEWS).glob('*.exr'))}
    if record is not None and not recorded:  # another program's; a damaged one is ours
        names.remove(METRICS)
    return frozenset(name for name in names if _is_name(name) and os.path.lexists(folder / name))


def _is_checkpoint(path: Path) -> bool:
    """Whether a file looks like a checkpoint of ours, by the names of its entries."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {'extra.npy', 'seen.npy', 'array.initial.npy'} <= {*archive.namelist()}
    except (OSError, ValueError, zipfile.BadZipFile):
        return False
