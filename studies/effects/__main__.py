"""Measure what modelling the effects of real projections is worth: fits that ignore them against fits that model them.

    python -m studies.effects
    python -m studies.effects --only hardening psf
    python -m studies.effects --docs docs

Simulates each of the shipped scenes effects/NAME with its effect, fits a cloud that ignores it and one that models it, and a
third to a scan without it. Writes effects.json to --out, where results of other effects are kept, with the table effects.md and
a picture of each effect, and to effects.provenance.json how they were made. With --docs, the pictures go there and the table
into a page there, too.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import Parser, docs_arguments, docs_of
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument(
        '--only', nargs='+', metavar='NAME', help='effects to measure, by the names of their scenes (default: all)'
    )
    p.add_argument('--out', type=Path, default=Path('out/effects'), metavar='D', help='folder of the results')
    docs_arguments(p, 'effects.md', 'figures/effects')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> None:
    args = arguments()
    require_writable(args.out, args.out, 'choose another --out')
    document, figures = docs_of(args)
    use_variant(args.variant)
    from lingo_mi.validation.markdown import check_places
    from studies.effects.experiments import EXPERIMENTS, experiment_of, measure
    from studies.effects.report import TABLE, make_table, write

    names = args.only or list(EXPERIMENTS)
    for name in names:
        experiment_of(name)
    if document:
        check_places(document, [TABLE])
    numbers = {}
    for name in names:
        numbers = write({name: measure(name)}, args.out, figures, document)
    print(make_table(numbers))


if __name__ == '__main__':
    run_study('effects', main)
