"""Measure what accuracy costs: error, time and memory of every way to compute the same projections, scaling, and fits.

    lingo-mi accuracy
    lingo-mi accuracy --quick
    lingo-mi accuracy --docs docs
    lingo-mi accuracy --presets --variant cuda_ad_mono --out out/cuda
    lingo-mi accuracy --presets --beside out/cuda/accuracy.json

It writes accuracy.json, accuracy.md and the plots to --out, and records in accuracy.provenance.json how they were made. The
full run takes 6 to 15 minutes on two cores, --quick under 3. With --docs, the plots go to that folder, and conditions and
presets into a page there.

--presets measures the table of the presets alone, which needs no ray tracing. --beside adds another variant's errors to it.
"""

import sys
import time
from pathlib import Path

from lingo_mi.cli.common import Parser, docs_arguments, docs_of
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable


def parser() -> Parser:
    p = Parser(description=__doc__)
    p.add_argument('--quick', action='store_true', help='smaller sizes and fewer repeats')
    p.add_argument('--presets', action='store_true', help='the presets alone: their table, no plots')
    p.add_argument(
        '--beside', type=Path, metavar='F', help="show another variant's errors with the presets: its accuracy.json"
    )
    p.add_argument('--out', type=Path, default=Path('out/accuracy'), metavar='D', help='folder of the results')
    docs_arguments(p, 'accuracy.md', 'figures')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p


def main() -> None:
    args = parser().parse_args()
    require_writable(args.out, args.out, 'choose another --out')
    document, figures = docs_of(args)
    use_variant(args.variant)
    from lingo_mi.validation.accuracy import FULL, QUICK, measure, measure_presets
    from lingo_mi.validation.accuracy.report import write
    from lingo_mi.validation.accuracy.tables import SHOWN, read_presets
    from lingo_mi.validation.markdown import check_places

    if document:
        check_places(document, ['presets'] if args.presets else SHOWN)
    beside = read_presets(args.beside) if args.beside else None
    sizes = QUICK if args.quick else FULL
    if args.presets:
        write(measure_presets(sizes), args.out, figures, document, beside)
        print(f'{args.out}/: accuracy.json, accuracy.md')
        return
    begun = time.perf_counter()
    results = measure(sizes, lambda part: print(f'{time.perf_counter() - begun:5.0f} s  {part}', file=sys.stderr))
    write(results, args.out, figures, document, beside)
    print(f'{args.out}/: accuracy.json, accuracy.md; {figures}/: pareto.png, scaling.png, fits.png')
