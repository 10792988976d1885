"""Measure the hard cases: a Markdown table of their errors, refusals and warnings.

    python -m studies.hard_cases
    python -m studies.hard_cases --markdown hard_cases.md
    python -m studies.hard_cases --variant cuda_ad_mono --json cuda.json
    python -m studies.hard_cases --variant llvm_ad_mono --beside cuda.json --markdown hard_cases.md

Every line is a case that the tests assert: relative errors of the image, and of the derivatives by the Gaussians' parameters,
in float32 against float64 (`studies.hard_cases.measuring` says how they are counted). The exit code is 1 where a case
misses its tolerance. Beside the page that --markdown names, FILE.provenance.json says how it was made.

The table shows two variants where --beside names the results of another, as --json wrote them; its misses count, too.
"""

import argparse
import sys
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable, write_text
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--markdown', type=Path, metavar='F', help='write the table there, too')
    p.add_argument('--json', type=Path, metavar='F', help='write all numbers there, for --beside')
    p.add_argument('--beside', type=Path, metavar='F', help="show another variant's results in columns of their own")
    p.add_argument('--steps', type=int, default=10_000, metavar='N', help='steps of the long fit (default: 10000)')
    p.add_argument(
        '--without', nargs='+', default=[], metavar='TEXT', help='leave out the cases whose names contain one of these'
    )
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> int:
    args = arguments()
    for path in filter(None, (args.markdown, args.json)):
        require_writable(path.parent, path, 'choose another file')
    if args.steps < 1:
        raise InputError(f'--steps must be at least 1, not {args.steps}')
    variant = use_variant(args.variant)
    from lingo_mi.validation.provenance import write_provenance
    from studies.hard_cases.cases import all_cases
    from studies.hard_cases.measuring import measure, miss
    from studies.hard_cases.table import markdown, store, stored

    beside = stored(args.beside) if args.beside else None
    cases = [case for case in all_cases(steps=args.steps) if not any(text in case.name for text in args.without)]
    results = []
    for case in cases:
        results.append((case, measure(case)))
        if args.json:  # after every case, so that a run that is stopped leaves what it has measured
            store(args.json, variant, results)
    missed = [(case.name, wrong) for case, result in results if (wrong := miss(case, result, variant))]
    if beside:
        missed += [(f'{name}, {beside.title}', wrong) for name, wrong in beside.misses(cases).items()]
    for name, wrong in missed:
        print(f'missed its tolerance: {name}: {wrong}', file=sys.stderr)
    table = markdown(results, beside)
    print(table, end='')
    if args.markdown:
        write_text(args.markdown, table)
        write_provenance(args.markdown)
    return int(bool(missed))


if __name__ == '__main__':
    run_study('hard_cases', main)
