"""The table of a cohort's results: CSV, and Parquet if pyarrow is installed."""

from __future__ import annotations

import csv
import importlib
import io
import time
from collections.abc import Iterable
from pathlib import Path

from lingo_mi.cohort.row import Row
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import reading, replacing, write_text

CSV, PARQUET, LOG = 'results.csv', 'results.parquet', 'batch.log'
FIRST = 'name', 'status', 'error', 'file', 'geometry', 'method', 'views', 'seed'
PAUSE = 5.0  # seconds between two updates while jobs run


class Table:
    """One row a scan: what was asked for, its status, and every number of its result."""

    def __init__(self, out: Path, rows: Iterable[Row]):
        """Raises InputError if a file of the table's name is not ours."""
        self.out, self._written = out, -PAUSE
        self._rows = {row.name: self._asked(row) for row in rows}
        path = out / CSV
        if path.is_symlink() or path.exists():
            with reading(path), open(path, encoding='utf-8', errors='replace') as file:
                if path.is_symlink() or not file.readline().startswith(','.join(FIRST)):
                    raise InputError(f'{path}: is not a table of a batch; move it away, or choose another folder')
        for other in (out / PARQUET, out / LOG):
            if other.is_symlink() or other.exists() and not (path.exists() and other.is_file()):
                raise InputError(f'{other}: does not belong to a batch; move it away, or choose another folder')

    @staticmethod
    def _asked(row: Row) -> dict:
        columns = {name: getattr(row, name) for name in FIRST if name not in ('status', 'error')}
        return columns | dict(status='waiting', error=None) | row.settings | row.parameters

    def done(self, name: str, numbers: dict) -> None:
        """Enter the metrics of a result; values that are not numbers are left out."""
        asked = self._rows[name]
        scalars = {k: v for k, v in numbers.items() if isinstance(v, int | float) and not isinstance(v, bool)}
        self._rows[name] = asked | scalars | dict(status='done', error=None)

    def state(self, name: str, status: str, error: str | None = None) -> None:
        self._rows[name] |= dict(status=status, error=error)

    def interrupted(self) -> None:
        for row in self._rows.values():
            if row['status'] == 'running':
                row['status'] = 'interrupted'

    def update(self, force: bool = True) -> None:
        """Write results.csv; without `force` not more often than every few seconds."""
        if not force and time.monotonic() - self._written < PAUSE:
            return
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns(), lineterminator='\n')
        writer.writeheader()
        writer.writerows(self._rows.values())
        write_text(self.out / CSV, text.getvalue())
        self._written = time.monotonic()

    def finish(self) -> list[Path]:
        """Write the table in every form; returns the files."""
        self.update()
        try:
            arrow, parquet = map(importlib.import_module, ('pyarrow', 'pyarrow.parquet'))
        except ImportError:
            return [self.out / CSV]
        columns = {name: _alike([row.get(name) for row in self._rows.values()]) for name in self._columns()}
        with replacing(self.out / PARQUET) as temporary:
            parquet.write_table(arrow.table({name: arrow.array(values) for name, values in columns.items()}), temporary)
        return [self.out / CSV, self.out / PARQUET]

    def _columns(self) -> list[str]:
        return list(dict.fromkeys([*FIRST, *(name for row in self._rows.values() for name in row)]))


def _alike(values: list) -> list:
    """Values of one column: all as text if one is, since a list gives as text what a result gives as a number."""
    text = any(isinstance(value, str) for value in values)
    return [None if value is None else str(value) for value in values] if text else values


class Log:
    """A line for every event, with its time; lines of earlier runs stay."""

    def __init__(self, out: Path):
        self._path = out / LOG

    def add(self, text: str) -> None:
        with open(self._path, 'a', encoding='utf-8', errors='backslashreplace') as file:
            file.write(f'{time.strftime("%Y-%m-%dT%H:%M:%S")} {text}\n')
