"""The report of `accuracy.measure`: numbers, tables, plots and their provenance."""

from __future__ import annotations

import json
from pathlib import Path

from lingo_mi.storage.file_access import write_text
from lingo_mi.validation.accuracy.plots import draw
from lingo_mi.validation.accuracy.tables import SHOWN, TITLES, make_tables
from lingo_mi.validation.markdown import insert_into
from lingo_mi.validation.provenance import write_provenance


def write(results: dict, folder: Path, figures: Path, document: Path | None = None, beside: dict | None = None) -> None:
    """Write accuracy.json and accuracy.md into `folder`, the plots into `figures`, and the tables SHOWN into a document.

    Of presets alone there is one table and no plot.

    `provenance` is written beside accuracy.md and beside the document.

    Parameters
    ----------
    document : Path or None
        A Markdown file with a place for each table that it shows; None: no document.
    beside : dict or None
        Another variant's presets, `tables.read_presets`.
    """
    tables = make_tables(results, beside)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / 'accuracy.json', json.dumps(results, indent=1) + '\n')
    text = '\n\n'.join(f'## {TITLES[name]}\n\n{table}' for name, table in tables.items())
    write_text(folder / 'accuracy.md', f'# Accuracy against time\n\n{text}\n')
    write_provenance(folder / 'accuracy.md')
    if 'methods' in results:
        figures.mkdir(parents=True, exist_ok=True)
        draw(results, figures)
    if document:
        insert_into(document, {name: table for name, table in tables.items() if name in SHOWN})
        write_provenance(document)
