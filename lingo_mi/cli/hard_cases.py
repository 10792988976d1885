"""Measure the hard cases of the tests: a Markdown table of their errors, refusals and warnings.

    python scripts/hard_cases.py
    python scripts/hard_cases.py --markdown hard_cases.md

Every line is a case that tests/test_hard_cases.py asserts: relative errors of the image, and of the derivatives by the
Gaussians' parameters, in float32 against float64 (tests/hard_cases.py says how they are counted). The exit code is 1
where a case misses its tolerance.
"""

import argparse
import sys
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.runtime import use_variant


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--markdown', type=Path, metavar='F', help='write the table there, too')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main():
    args = arguments()
    use_variant(args.variant)
    sys.path.insert(0, str(Path('tests').resolve()))
    from helpers.hard_cases import cases, check, markdown, measure

    results, missed = [], 0
    for case in cases(steps=10_000):
        try:
            results.append((case, check(case)))
        except AssertionError:
            results.append((case, measure(case)))
            print(f'missed its tolerance: {case.name}', file=sys.stderr)
            missed += 1
    table = markdown(results)
    print(table, end='')
    if args.markdown:
        args.markdown.write_text(table)
    return int(missed > 0)
