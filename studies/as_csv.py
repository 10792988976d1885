"""The tables of the pages that studies write, as data.

    python -m studies.as_csv out/tables/views.md docs/tables

writes the table of the page to docs/tables/views.csv. If the page has several, each file also has its heading's name.
"""

from __future__ import annotations

import argparse
import csv
import re
from pathlib import Path

from lingo_mi.storage.file_access import reading, replacing


def cells(page: str) -> dict[str, list[list[str]]]:
    """The cells of the tables of a page, the titles first, by the heading above each.

    >>> cells(chr(10).join(['# Times', '| a | b |', '|---|---:|', '| 1 | 2.0 |']))
    {'Times': [['a', 'b'], ['1', '2.0']]}
    """
    tables: dict[str, list[list[str]]] = {}
    heading = ''
    for line in page.splitlines():
        if line.startswith('#'):
            heading = line.lstrip('#').strip()
        elif line.startswith('|') and not re.fullmatch(r'[|:\- ]+', line):
            tables.setdefault(heading, []).append([cell.strip() for cell in line.strip().strip('|').split('|')])
    return tables


def store(page: Path, folder: Path) -> list[Path]:
    """Write the tables of a page as CSV files: PAGE.csv, or PAGE_HEADING.csv if there are several. Returns the files."""
    with reading(page):
        tables = cells(page.read_text(encoding='utf-8'))
    paths = []
    for heading, rows in tables.items():
        name = page.stem if len(tables) == 1 else f'{page.stem}_{re.sub("[^a-z0-9]+", "_", heading.lower())}'
        paths.append(folder / f'{name}.csv')
        with replacing(paths[-1]) as temporary, temporary.open('w', encoding='utf-8', newline='') as file:
            csv.writer(file, lineterminator='\n').writerows(rows)
    return paths


def main() -> None:
    p = argparse.ArgumentParser(description='Write the tables of a Markdown page as CSV files.')
    p.add_argument('page', type=Path, metavar='PAGE.md')
    p.add_argument('folder', type=Path)
    args = p.parse_args()
    print(*store(args.page, args.folder), sep='\n')


if __name__ == '__main__':
    main()
