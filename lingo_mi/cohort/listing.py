"""Reads the list of a cohort, and finds all that is wrong with it before any work begins."""

from __future__ import annotations

import csv
import io
import os
import re
import unicodedata
from functools import lru_cache
from os import PathLike
from pathlib import Path

from lingo_mi.cohort.row import COLUMNS, Row, scene_of
from lingo_mi.common.errors import InputError, printable, shown
from lingo_mi.common.parsing import MOST_SEED, nearest
from lingo_mi.files.geometry_file import load_yaml
from lingo_mi.files.scans import reader_of
from lingo_mi.fitting.methods.by_name import known_options
from lingo_mi.scene.load import defaults
from lingo_mi.storage.file_access import reading

RESERVED = 'results.csv', 'results.parquet', 'batch.log'  # names in the output folder
MOST_NAME = 100  # bytes of a name
_ENDINGS = '.nii.gz', '.npy.gz', '.raw.gz'
_NAME = re.compile(
    r'\w(?:[\w .+,=@()-]*[\w)+@-])?'
)  # a name of a folder on any system, which is not an option of a command
_DEVICES = re.compile(r'(con|prn|aux|nul|com\d|lpt\d)(\..*)?', re.IGNORECASE)  # of Windows


class BadList(InputError):
    """A list with rows that cannot be used; `lines`: one for each of them."""

    def __init__(self, message: str, lines: list[str]):
        super().__init__(message)
        self.lines = lines


def read_list(path: PathLike | str, method: str = 'fast') -> list[Row]:
    """The rows of a list: CSV in UTF-8, with a byte-order mark or without, separated by commas, semicolons or tabs.

       The first line names the columns (`row.COLUMNS`, options of methods, parameters of scenes). An empty cell is the default.
       Relative paths begin from the list's folder.

       Raises InputError if the file is not such a list, and `BadList` for rows that cannot be used.

           rows = read_list('cohort.csv')   # file,views
    foot.pickle,25
    hand.pickle,10

    Parameters
    ----------
    method : str
        Method of the rows that do not name one.
    """
    path = Path(path)
    header, records = _records(path)
    rows, bad, names = [], [], {}
    for line, cells in records:
        where = f'{path.name}, line {line}'  # the last line has the whole path
        try:
            if len(cells) != len(header):
                raise InputError(f'has {len(cells)} cells, but the header has {len(header)}')
            row = _row(dict(zip(header, map(str.strip, cells))), line, path.parent, method)
            where += f' ({row.name})'
            key = unicodedata.normalize('NFC', row.name).casefold()  # some file systems do not tell them apart
            if key in names:
                raise InputError(f'line {names[key]} has the same name; give each row another one, in a column name')
            names[key] = line
            _check(row)
        except InputError as error:
            bad.append(printable(f'{where}: {error}'))
        else:
            rows.append(row)
    if bad:
        raise BadList(f'{path}: {len(bad)} of {len(records)} rows cannot be used, so nothing was begun', bad)
    return rows


def _records(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The names of the columns, and the cells of every row that is not blank, with its line."""
    with reading(path):
        content = path.read_bytes()
    if content.startswith((b'\xff\xfe', b'\xfe\xff')):
        raise InputError(f'{path}: is UTF-16; save it as CSV in UTF-8')
    try:
        text = content.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        line = content.count(b'\n', 0, error.start) + 1
        raise InputError(f'{path}, line {line}: is not UTF-8; save it as CSV in UTF-8') from None
    first = next((line for line in text.splitlines() if line.strip()), '')
    reader = csv.reader(io.StringIO(text, newline=''), delimiter=max(',;\t', key=first.count), strict=True)
    try:
        records = [(reader.line_num, cells) for cells in reader if any(map(str.strip, cells))]
    except csv.Error as error:
        raise InputError(f'{path}, line {reader.line_num}: is not CSV ({error}); correct its quotes') from None
    if not records:
        raise InputError(f'{path}: is empty; its first line must name the columns, such as file,geometry,views')
    header = [name.strip() for name in records[0][1]]
    _check_header(path, header)
    if len(records) == 1:
        raise InputError(f'{path}: has a header, but no scan below it')
    return header, records[1:]


def _check_header(path: Path, header: list[str]) -> None:
    if not {'file', 'geometry'} & {*header}:
        raise InputError(
            f'{path}: has no column file: the first line must name the columns, not {shown(",".join(header))}'
        )
    for name in header:
        if not name:
            raise InputError(f'{path}: column {header.index(name) + 1} has no name')
        if header.count(name) > 1:
            raise InputError(f'{path}: has {header.count(name)} columns {shown(name)}; keep one')


def _row(cells: dict[str, str], line: int, folder: Path, method: str) -> Row:
    values = {name: text for name, text in cells.items() if text}
    columns = {name: values.pop(name) for name in COLUMNS if name in values}
    file, geometry = columns.get('file', ''), columns.get('geometry', '')
    if not (file or geometry):
        raise InputError('names neither a file nor a scene')
    scene = scene_of(folder, geometry)
    of_scene = _parameters(scene) if scene else frozenset()
    method = columns.get('method', method)
    settings = {name: text for name, text in values.items() if name not in of_scene}
    accepted = known_options(method, settings)
    for name in settings:
        if name not in accepted:
            raise InputError(
                f'{shown(name)} is neither a column of a list ({", ".join(COLUMNS)}) nor an option of {shown(method)}'
                + (f' nor a parameter of {geometry}' if scene else '')
                + nearest(name, [*COLUMNS, *accepted, *of_scene])
            )
    return Row(
        name=columns.get('name') or _stem(file or str(scene)),
        line=line,
        folder=str(folder.resolve()),
        file=file,
        geometry=geometry,
        method=method,
        views=_whole('views', columns['views'], 1) if 'views' in columns else None,
        seed=_whole('seed', columns.get('seed', '0'), 0),
        mu_water=_positive('mu_water', columns['mu_water']) if 'mu_water' in columns else None,
        settings=settings,
        parameters={name: text for name, text in values.items() if name in of_scene},
    )


def _check(row: Row) -> None:
    """Raises InputError for what can be seen without reading a scan."""
    name = row.name
    if not _NAME.fullmatch(name) or _DEVICES.fullmatch(name) or len(name.encode()) > MOST_NAME:
        raise InputError(
            f'{shown(name)} is not a name of a folder: use letters, digits, spaces and _.+,=@()-, at most {MOST_NAME} bytes, '
            'in a column name'
        )
    if name.casefold() in RESERVED:
        raise InputError('a file of the batch has this name; choose another, in a column name')
    row.fit_method()
    path = row.path
    if path is not None:
        with reading(path, folder=path.is_dir()):
            if not os.access(path, os.R_OK):
                raise InputError(f'{path}: may not be read; check its permissions')
    if row.scene is not None:
        return
    if path is None:
        raise InputError('has no file')
    if row.mu_water is not None:
        raise InputError('mu_water is for a CT volume, which a scene in the column geometry scans')
    geometry = Path(row.folder) / row.geometry if row.geometry else None
    reader_of(path, geometry)
    if geometry:
        load_yaml(geometry)


@lru_cache(1000)
def _parameters(scene: Path) -> frozenset[str]:
    return frozenset(defaults(scene))


def _stem(file: str) -> str:
    name = Path(file).name
    for ending in _ENDINGS:
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return Path(name).stem


def _whole(name: str, text: str, least: int) -> int:
    if not re.fullmatch(r'\d{1,19}', text, re.ASCII) or not least <= int(text) <= MOST_SEED:
        raise InputError(f'{name} must be a whole number from {least} on, not {shown(text)}')
    return int(text)


def _positive(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise InputError(f'{name} must be a number above 0, not {shown(text)}')
    return value
