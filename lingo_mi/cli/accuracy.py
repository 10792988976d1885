"""Measure what accuracy costs: error, time and memory of every way to compute the same projections, scaling, and fits.

    python scripts/accuracy.py
    python scripts/accuracy.py --quick

Writes accuracy.json and accuracy.md to --out. The full run (6 to 15 minutes on two cores) also renews docs/figures/ and
the tables in docs/accuracy.md; --quick (under 3 minutes) leaves them alone, without --docs, and writes its plots to --out.
"""

import argparse
import sys
import time
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.runtime import use_variant

DOCS = Path('docs')


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--quick', action='store_true', help='smaller sizes and fewer repeats')
    p.add_argument('--out', type=Path, default=Path('out/accuracy'), metavar='D', help='folder of the results')
    p.add_argument('--docs', action='store_true', help='renew docs/ after a quick run, too')
    p.add_argument(
        '--figures', type=Path, metavar='DIR', help='folder of the plots (default: docs/figures, or --out if quick)'
    )
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main():
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.studies.accuracy import FULL, QUICK, measure
    from lingo_mi.studies.accuracy.report import write

    begun = time.perf_counter()
    found = measure(
        QUICK if args.quick else FULL,
        lambda part: print(f'{time.perf_counter() - begun:5.0f} s  {part}', file=sys.stderr),
    )
    renew = args.docs or not args.quick
    figures = args.figures or (DOCS / 'figures' if renew else args.out)
    write(found, args.out, figures, DOCS / 'accuracy.md' if renew else None)
    print(f'{args.out}/: accuracy.json, accuracy.md; {figures}/: pareto.png, scaling.png, fits.png')
