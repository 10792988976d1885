"""The numbers of cells in one file, to be kept where checkpoints are too large: a line a cell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import read_json, write_text


class Record:
    """A file of cells by their keys.

    Parameters
    ----------
    path : Path
        Path of the file, which need not exist.

    Raises
    ------
    InputError
        If the file is damaged.
    """

    def __init__(self, path: Path):
        self.path = path
        self._cells: Any = read_json(path) if path.exists() else {}
        if not isinstance(self._cells, dict) or not all(isinstance(cell, dict) for cell in self._cells.values()):
            raise InputError(f'{path}: is not a record of cells; choose another --record')

    def get(self, key: str) -> dict | None:
        """The numbers of a cell; None if it is not recorded."""
        return self._cells.get(key)

    def add(self, cells: dict[str, dict]) -> None:
        """Record the numbers and texts of cells, without what has parts, and write the file."""
        new = {key: _scalars(cell) for key, cell in cells.items()}
        if all(self._cells.get(key) == cell for key, cell in new.items()):
            return
        self._cells |= new
        lines = [f'{json.dumps(key)}: {json.dumps(self._cells[key])}' for key in sorted(self._cells)]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_text(self.path, '{\n' + ',\n'.join(lines) + '\n}\n')


def _scalars(cell: dict) -> dict:
    provenance = cell.get('provenance') or {}
    scalars = {k: round(v, 6) if isinstance(v, float) else v for k, v in cell.items() if not isinstance(v, dict | list)}
    return scalars | {k: provenance[k] for k in ('commit', 'date', 'machine') if k in provenance}
