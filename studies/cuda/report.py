"""The tables of docs/gpu.md, from what `count` counted.

    python -m lingo_mi.studies.cuda.report --before before.json docs/gpu.md

before.json holds the counts of an earlier version, as `count` writes them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from lingo_mi.studies.cuda.model import CARDS, counts, largest, seconds, times
from lingo_mi.studies.markdown import insert_into, table

PASSES = dict(image='image', derivatives='derivatives', step='a step')


def per_pair(kernels: list[dict], pairs: float) -> dict:
    """Of the largest kernel: instructions of warps a pair, lanes at work, sectors a pair, those of atomics, predicted ms."""
    kernel = largest(kernels)
    instructions = sum(kernel['warp'].values())
    sectors = kernel['loads'] + kernel['stores'] + kernel['atomics']
    return dict(
        instructions=instructions / pairs,
        lanes=kernel['lanes'] / (32 * instructions),
        sectors=sectors / pairs,
        atomics=kernel['atomics'] / pairs,
        ms=1e3 * seconds(kernel, CARDS[0]),
    )


def compared(before: dict, after: dict) -> str:
    """The table of the two large kernels before and after, by cloud."""
    rows = []
    for cloud in after:
        for part in ('image', 'derivatives'):
            old, new = (per_pair(found[cloud][part], found[cloud]['pairs']) for found in (before, after))
            rows.append(dict(title=f'{cloud}, {part}', old=old, new=new))

    def column(title, name, form):
        return title, lambda r: f'{form.format(r["old"][name])} → {form.format(r["new"][name])}'

    return table(
        [
            ('cloud, pass', lambda r: r['title']),
            column('warp instructions a pair', 'instructions', '{:.2f}'),
            column('lanes at work', 'lanes', '{:.2f}'),
            column('sectors a pair', 'sectors', '{:.3f}'),
            column('of them atomic', 'atomics', '{:.3f}'),
            column(f'{CARDS[0].name}, ms', 'ms', '{:.3f}'),
        ],
        rows,
    )


def sizes(found: dict) -> str:
    """The table of the clouds."""
    return table(
        [
            ('cloud', lambda r: r[0]),
            ('Gaussians', lambda r: f'{r[1]["gaussians"]:,}'),
            ('pixels', lambda r: f'{r[1]["pixels"]:,}'),
            ('pairs inside the cut-off', lambda r: f'{r[1]["pairs"]:.2e}'),
            ('a Gaussian', lambda r: f'{r[1]["pairs"] / r[1]["gaussians"]:,.0f}'),
        ],
        found.items(),  # type: ignore[arg-type] - rows of any kind do
    )


def predictions(found: dict) -> str:
    """The table of predicted milliseconds by cloud and card, with what bounds the largest kernel."""
    rows = [
        (f'{cloud}, {PASSES[part]}', parts[part]) for cloud, parts in found.items() for part in PASSES if part in parts
    ]

    def cell(card):
        def text(row):
            total = sum(seconds(kernel, card) for kernel in row[1])
            needs = times(largest(row[1]), card)
            return f'{1e3 * total:.2f} ({max(needs, key=lambda name: needs[name])})'

        return text

    columns = [('cloud, part', lambda r: r[0]), *((f'{card.name}, ms', cell(card)) for card in CARDS)]
    return table(columns, rows)  # type: ignore[arg-type]


def kernels(found: dict) -> str:
    """The table of the kernels of a step of the foot that take longest, on the first card."""
    card, step = CARDS[0], found['foot']['step']
    total = sum(seconds(kernel, card) for kernel in step)
    rows = sorted(step, key=lambda kernel: -seconds(kernel, card))[:8]
    return table(
        [
            ('launches', lambda k: f'{k["launches"]}'),
            ('warp instructions', lambda k: f'{sum(k["warp"].values()):.1e}'),
            ('of them float64', lambda k: f'{k["warp"]["fp64"]:.1e}'),
            ('sectors', lambda k: f'{k["loads"] + k["stores"] + k["atomics"]:.1e}'),
            (f'{card.name}, ms', lambda k: f'{1e3 * seconds(k, card):.3f}'),
            ('share', lambda k: f'{seconds(k, card) / total:.0%}'),
        ],
        rows,
    )


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('document', type=Path)
    p.add_argument('--before', type=Path, required=True, help='counts of an earlier version')
    args = p.parse_args()
    found, before = counts(), json.loads(args.before.read_text())
    tables = dict(
        clouds=sizes(found), counted=compared(before, found), predicted=predictions(found), kernels=kernels(found)
    )
    insert_into(args.document, tables)


if __name__ == '__main__':
    main()
