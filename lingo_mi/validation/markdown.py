"""Markdown tables, and their positions in a document: between `<!-- table NAME -->` and `<!-- end NAME -->`."""

from __future__ import annotations

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

    Parameters
    ----------
    tables : dict[str, str]
        Markdown by name.
    where : str or Path
        Name of the text, for the error.

    Raises
    ------
    InputError
        If a table has no place.
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
    """`insert` the tables into a file.

    Raises
    ------
    InputError
        If it cannot be read or written, or a table has no place.
    """
    text = insert(_read(document), tables, document)
    with replacing(document) as temporary:
        temporary.write_text(text, encoding='utf-8')


def check_places(document: Path, names: Iterable[str]) -> None:
    """Raises InputError if a document cannot be read or a table has no place in it: before hours of measuring."""
    insert(_read(document), dict.fromkeys(names, ''), document)


def _read(document: Path) -> str:
    with reading(document):
        return Path(document).read_text(encoding='utf-8')
