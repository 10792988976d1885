"""Measure the hard cases: a Markdown table of their errors, refusals and warnings.

    lingo-mi hard-cases
    lingo-mi hard-cases --markdown hard_cases.md

Every line is a case that the tests assert: relative errors of the image, and of the derivatives by the Gaussians' parameters,
in float32 against float64 (`lingo_mi.studies.hard_cases.measuring` says how they are counted). The exit code is 1 where a case
misses its tolerance. Beside the page that --markdown names, FILE.provenance.json says how it was made.
"""

import argparse
import sys
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.runtime import use_variant


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--markdown', type=Path, metavar='F', help='write the table there, too')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> int:
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.studies.hard_cases.cases import all_cases
    from lingo_mi.studies.hard_cases.measuring import measure, miss
    from lingo_mi.studies.hard_cases.table import markdown
    from lingo_mi.studies.provenance import write_provenance

    results = [(case, measure(case)) for case in all_cases(steps=10_000)]
    missed = [(case, wrong) for case, result in results if (wrong := miss(case, result))]
    for case, wrong in missed:
        print(f'missed its tolerance: {case.name}: {wrong}', file=sys.stderr)
    table = markdown(results)
    print(table, end='')
    if args.markdown:
        args.markdown.write_text(table, encoding='utf-8')
        write_provenance(args.markdown)
    return int(bool(missed))
