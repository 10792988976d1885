"""Helpers of the studies' commands: `python -m studies.NAME`, and a table that is updated cell by cell."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lingo_mi.cli.common import guard
from lingo_mi.storage.file_access import write_text
from lingo_mi.storage.folder_lock import locked
from lingo_mi.validation.provenance import write_provenance


def run_study(name: str, main: Callable[[], int | None]) -> None:
    """Run the main function of `python -m studies.NAME`, and exit as `lingo-mi` does: 2 with one line for bad input."""
    sys.argv[0] = f'python -m studies.{name}'  # for its help and its provenance, in place of a file's name
    guard(main)


@contextmanager
def updated_table(file: Path, table: Callable[[], str]) -> Iterator[Callable[[str], None]]:
    """The table of a study that stores its cells one by one, as Markdown in a file whose folder is locked meanwhile.

    Gives a function to call with a line after each cell: it prints the line and writes the table anew, with its provenance. At
    the end the table is printed. After KeyboardInterrupt the same command goes on.
    """

    def update(line: str) -> None:
        print(line, flush=True)
        write()

    def write() -> None:
        write_text(file, table() + '\n')
        write_provenance(file)

    with locked(file.parent):
        try:
            yield update
        except KeyboardInterrupt:
            raise KeyboardInterrupt('the same command goes on from here') from None
        write()
    print(table())
