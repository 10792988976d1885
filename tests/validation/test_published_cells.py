"""The cells of docs/tables belong to today's code, so that a table goes on from them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from lingo_mi.validation.tables.cells import SCALES, Cells, Fit

TABLES = Path(__file__).parents[2] / 'docs' / 'tables'


@pytest.mark.parametrize(('table', 'scale'), [('controls', 'small'), ('paper', 'paper')])
def test_published_cells_are_those_of_today(table, scale):
    """A setting that came later must not orphan them: `LATER` names those."""
    scales = [replace(SCALES[scale], first=first) for first in (False, True)]
    for key in json.loads((TABLES / table / 'cells.json').read_text(encoding='utf-8')):
        name, views, folder, iterations, _ = key.split('/')
        fit = Fit(name, int(views.partition('_')[0]), folder.rpartition('_')[0].replace('_', ':', 1), int(iterations))
        assert key in {Cells(Path(), s, seed).path(fit).as_posix() for s in scales for seed in range(3)}
