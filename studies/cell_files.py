"""Cells of a study below a folder: a JSON file each.

They are written atomically, so that a study goes on where it was stopped:

    cells = CellFiles(Path('out/regret'), 'psnr_3d', 'seconds')
    cells.put('foot', 'best', dict(psnr_3d=36.9, seconds=120.0))
    cells.get('foot', 'best')
"""

from __future__ import annotations

import json
from pathlib import Path

from lingo_mi.storage.file_access import write_text


class CellFiles:
    """The cells below a folder. needed: keys without which a file is not a cell."""

    def __init__(self, folder: Path, *needed: str):
        self.folder, self.needed = Path(folder), needed

    def path(self, case: str, setting: str) -> Path:
        return self.folder / case / f'{setting}.json'

    def get(self, case: str, setting: str) -> dict | None:
        """A stored cell, or None if there is none that can be read."""
        try:
            cell = json.loads(self.path(case, setting).read_text(encoding='utf-8'))
        except (OSError, ValueError):
            return None
        return cell if isinstance(cell, dict) and cell.keys() >= set(self.needed) else None

    def put(self, case: str, setting: str, cell: dict) -> None:
        path = self.path(case, setting)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(cell, indent=1) + '\n')
