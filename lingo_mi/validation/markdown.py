"""Markdown tables, their positions in a document, between `<!-- table NAME -->` and `<!-- end NAME -->`, and their cells as data.

    python -m lingo_mi.validation.markdown out/tables/views.md docs/tables

writes the table of the page to docs/tables/views.csv, or each of several tables to a file that also has its heading's name.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import reading, replacing

Column = tuple[str, Callable[[Any], str]]  # the title, and the cell of a row


def table(columns: list[Column], rows: Iterable[Any], first: str | None = None) -> str:
    """A Markdown table. first   another title for the first column

    >>> print(table([('a', lambda r: r['a']), ('b', lambda r: f'{r["b"]:.1f}')], [dict(a='x', b=2)]))
    | a | b |
    |---|---:|
    | x | 2.0 |
    """
    titles = [first or columns[0][0], *(title for title, _ in columns[1:])]
    lines = ['| ' + ' | '.join(titles) + ' |', '|---|' + '---:|' * (len(titles) - 1)]
    return '\n'.join(lines + ['| ' + ' | '.join(cell(row) for _, cell in columns) + ' |' for row in rows])


def insert(text: str, tables: dict[str, str], where: str | Path = 'the document') -> str:
    """The text with what stands in the places of the tables replaced by them.

    tables   Markdown by name
    where    what the text is, for the error

    Raises InputError where a table has no place.
    """
    for name, table in tables.items():
        pattern = re.compile(f'(<!-- table {name} -->\n).*?(<!-- end {name} -->)', re.DOTALL)
        if not pattern.search(text):
            raise InputError(
                f'{where}: there is no place for the table {name}: add a line <!-- table {name} --> and a line '
                f'<!-- end {name} -->'
            )
        text = pattern.sub(lambda m: f'{m[1]}{table}\n{m[2]}', text)
    return text


def insert_into(document: Path, tables: dict[str, str]) -> None:
    """`insert` the tables into a file. Raises InputError where it cannot be read or written, or a table has no place."""
    text = insert(_read(document), tables, document)
    with replacing(document) as temporary:
        temporary.write_text(text, encoding='utf-8')


def check_places(document: Path, names: Iterable[str]) -> None:
    """Raises InputError where a document cannot be read or a table has no place in it: before hours of measuring."""
    insert(_read(document), dict.fromkeys(names, ''), document)


def cells(page: str) -> dict[str, list[list[str]]]:
    """The cells of the tables of a page, the titles first, by the heading above each.

    >>> cells('# Times' + chr(10) + table([('a', str)], [1]))
    {'Times': [['a'], ['1']]}
    """
    found: dict[str, list[list[str]]] = {}
    heading = ''
    for line in page.splitlines():
        if line.startswith('#'):
            heading = line.lstrip('#').strip()
        elif line.startswith('|') and not re.fullmatch(r'[|:\- ]+', line):
            found.setdefault(heading, []).append([cell.strip() for cell in line.strip().strip('|').split('|')])
    return found


def store(page: Path, folder: Path) -> list[Path]:
    """Write the tables of a page as CSV files: PAGE.csv, or PAGE_HEADING.csv where there are several. Returns the files."""
    found = cells(_read(page))
    paths = []
    for heading, rows in found.items():
        name = page.stem if len(found) == 1 else f'{page.stem}_{re.sub("[^a-z0-9]+", "_", heading.lower())}'
        paths.append(folder / f'{name}.csv')
        with replacing(paths[-1]) as temporary, temporary.open('w', encoding='utf-8', newline='') as file:
            csv.writer(file, lineterminator='\n').writerows(rows)
    return paths


def _read(document: Path) -> str:
    with reading(document):
        return Path(document).read_text(encoding='utf-8')


def main() -> None:
    p = argparse.ArgumentParser(description='Write the tables of a Markdown page as CSV files.')
    p.add_argument('page', type=Path)
    p.add_argument('folder', type=Path)
    args = p.parse_args()
    print(*store(args.page, args.folder), sep='\n')


if __name__ == '__main__':
    main()
