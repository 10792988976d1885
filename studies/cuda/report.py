"""The table of studies/cuda/README.md: what the model predicts for cards that were not at hand, from what `count` counted.

    python -m studies.cuda.report studies/cuda/README.md

writes it between its markers.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from lingo_mi.validation.cuda_model import CARDS, counts, seconds
from lingo_mi.validation.markdown import insert_into, table


def predictions(results: dict) -> str:
    """The table of predicted milliseconds of a step, by cloud and card."""
    rows = [(cloud, parts['step']) for cloud, parts in results.items() if 'step' in parts]

    def cell(card):
        return lambda row: f'{1e3 * sum(seconds(kernel, card) for kernel in row[1]):.2f}'

    columns = [('a step of', lambda r: r[0]), *((f'{card.name}, ms', cell(card)) for card in CARDS)]
    return table(columns, rows)  # type: ignore[arg-type]


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('document', type=Path)
    insert_into(p.parse_args().document, dict(predicted=predictions(counts())))


if __name__ == '__main__':
    main()
