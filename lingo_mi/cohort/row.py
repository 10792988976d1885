"""One scan of a cohort: what to read, how to fit it, and the folder of its result."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path

from lingo_mi.common.errors import InputError, shown
from lingo_mi.files.geometry_file import geometry_file_of, named_files
from lingo_mi.files.scans import ARRAYS
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.by_name import method_of
from lingo_mi.scene import outline
from lingo_mi.scene.shipped import scene_path, scenes
from lingo_mi.storage.file_access import parsed_json, reading
from lingo_mi.storage.output_folder import CHECKPOINT, FILES, METRICS, occupants, require_ours

# How columns of a list are read; every other column is an option of the method, or a parameter of the row's scene.
COLUMNS = 'name', 'file', 'geometry', 'method', 'views', 'seed', 'mu_water'
CONTENT = 'content of the geometry'  # keys of a request
SCAN = 'content of the scan'
NAMED = 'content of files that the geometry names'
SYSTEM = '.DS_Store', 'Thumbs.db', 'desktop.ini'  # what desktops leave in folders


@dataclass(frozen=True)
class Row:
    """One scan of a list.

    Parameters
    ----------
    name : str
        Name of the folder of its result.
    line : int
        Line in the list.
    folder : str
        Folder of the list, from which relative paths begin.
    file : str
        Projections; with a scene for the geometry, a CT volume for its scanner, or '' for its own objects.
    geometry : str
        '', a geometry file, or a scene: its file, or the name of a shipped one.
    method : str
        Method of the fit: `name` or `name:option=value,...`.
    views : int or None
        Evenly spaced ones to fit; None: all.
    seed : int
        Seed of every random choice.
    mu_water : float or None
        Attenuation of water for a CT volume in Hounsfield units, 1/mm.
    settings : dict[str, str]
        Options that differ from the method's, as text.
    parameters : dict[str, str]
        Parameters of the scene, as text.
    """

    name: str
    line: int
    folder: str
    file: str = ''
    geometry: str = ''
    method: str = 'fast'
    views: int | None = None
    seed: int = 0
    mu_water: float | None = None
    settings: dict[str, str] = field(default_factory=dict)
    parameters: dict[str, str] = field(default_factory=dict)

    @property
    def path(self) -> Path | None:
        """Path of the file."""
        return Path(self.folder) / self.file if self.file else None

    @property
    def scene(self) -> Path | None:
        """The file of the scene; None if the geometry is not a scene.

        Raises
        ------
        InputError
            If there is no such scene.
        """
        return scene_of(Path(self.folder), self.geometry)

    def fit_method(self) -> Method:
        """The method with the row's options.

        Raises
        ------
        InputError
            For an unknown option, or a value out of its range.
        """
        return method_of(self.method, **self.settings)

    def request(self) -> dict:
        """Describe the request that a stored result must answer: the file's name in the list, its size, the contents of its
        scan, and everything else that the numbers depend on."""
        path = self.path
        size = path.stat().st_size if path is not None and path.is_file() else None
        settings = _asked(self.fit_method())
        request = {k: v for k, v in asdict(self).items() if k not in ('line', 'folder', 'settings')}
        geometry = Path(self.folder) / self.geometry
        if self.geometry and geometry.is_file():  # else it is the name of a shipped scene
            request[CONTENT] = hashlib.sha256(geometry.read_bytes()).hexdigest()
        if path is not None and path.exists():
            request[SCAN] = _digest(_files(path, geometry if self.geometry else None))
        if others := self._named():
            request[NAMED] = _digest(others)
        return json.loads(json.dumps(request | dict(bytes=size, settings=settings)))  # as if read from a file

    def _named(self):
        """The files that the geometry names and the numbers depend on."""
        if self.scene is not None:
            return [f for f in outline.scene_files(self.scene, self.parameters) if f.resolve() != self.scene.resolve()]
        return named_files(Path(self.folder) / self.geometry) if self.geometry else []


def scene_of(folder: Path, geometry: str) -> Path | None:
    """The file of the scene that a column `geometry` names; None for a geometry file, and for ''.

    Raises
    ------
    InputError
        If it names neither.
    """
    if geometry.endswith('.xml'):
        return scene_path(folder / geometry)
    if not geometry or Path(geometry).suffix.lower() in ('.yml', '.yaml'):
        return None
    if geometry not in scenes():
        raise InputError(
            f'geometry {shown(geometry)}: must be a geometry file (.yml) or a scene (.xml, or {", ".join(scenes())})'
        )
    return scene_path(geometry)


def _files(path, geometry):
    """All files of a scan: the files of a folder, or the file. An array without another geometry also has its geometry file and
    the files named there."""
    files = [path]
    if path.is_dir():
        files = [file for file in path.rglob('*') if file.is_file() and file.name not in SYSTEM]
    if path.suffix.lower() not in ARRAYS or geometry is not None:
        return files
    beside = geometry_file_of(path)
    return [*files, beside, *named_files(beside)]


def _digest(files):
    return _digest_of(tuple((file, file.stat().st_size, file.stat().st_mtime_ns) for file in sorted(files)))


@lru_cache(maxsize=1024)
def _digest_of(files):
    """Return a digest of the contents of (file, size, time of change). A file that has not changed is read once."""
    hasher = hashlib.sha256()
    for file, *_ in files:
        hasher.update(file.name.encode(errors='surrogateescape'))
        with open(file, 'rb') as stream:
            while part := stream.read(2**24):
                hasher.update(part)
    return hasher.hexdigest()


def _asked(method):
    """The options that the numbers depend on."""
    return {name: value for name, value in method.flat().items() if name != 'checkpoint_seconds'}


def stored(out: Path, row: Row) -> dict | None:
    """The metrics of a row's whole result in the folder `out`; None if it has not been completed.

    Raises
    ------
    InputError
        If the row's folder holds something else: another row's result, or files that are not ours.
    """
    folder = out / row.name
    if folder.is_symlink() or folder.exists() and not folder.is_dir():
        raise InputError(f'{folder}: is a link or a file, not a folder; move it away, or give another name')
    there = occupants(folder) if folder.is_dir() else []
    if not there:
        return None
    if METRICS not in there and CHECKPOINT not in there:
        raise InputError(f'{folder}: holds files but no result; move it away, or give another name')
    require_ours(folder, FILES)
    if METRICS not in there:
        return None
    try:
        with reading(folder / METRICS):
            metrics = parsed_json((folder / METRICS).read_text(encoding='utf-8'))
        files, asked = metrics['files'], metrics.get('request')
        before = asked['settings'].items() if isinstance(asked, dict) else ()
    except (KeyError, TypeError, AttributeError, ValueError):
        raise InputError(f'{folder / METRICS}: is damaged; remove the folder, or give another name') from None
    if not isinstance(asked, dict):
        raise InputError(f'{folder}: holds a result that no list made; give another name')
    wanted = row.request()
    if changed := [k for k in wanted if asked.get(k) != wanted[k]]:
        if changed == ['settings']:
            changed = [k for k, v in wanted['settings'].items() if (k, v) not in before]
        raise InputError(
            f'{folder}: holds a result of other values of {", ".join(changed)}; remove it, or give another name'
        )
    missing = [name for name in files if not (folder / name).exists()]
    if missing:
        raise InputError(f'{folder / missing[0]}: is missing from a whole result; remove the folder, to fit it again')
    return metrics
