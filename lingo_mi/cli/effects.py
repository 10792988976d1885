"""Measure what modelling the effects of real projections is worth: fits that ignore them against fits that model them.

    python scripts/effects.py
    python scripts/effects.py --only hardening psf

Simulates each scene of scenes/effects/ with its effect, fits a cloud that ignores it and one that models it, and a third to a
scan without it. Writes effects.json to --out, where results of other effects are kept, the pictures to docs/figures/effects/,
and the table into docs/effects.md.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.runtime import use_variant

DOCS = Path('docs')


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument(
        '--only', nargs='+', metavar='NAME', help='these effects, by the names of their scenes (default: all)'
    )
    p.add_argument('--out', type=Path, default=Path('out/effects'), metavar='D', help='folder of the results')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main():
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.studies.effects import EXPERIMENTS, make_table, measure, write

    for name in args.only or EXPERIMENTS:
        numbers = write({name: measure(name)}, args.out, DOCS / 'figures' / 'effects', DOCS / 'effects.md')
    print(make_table(numbers))
