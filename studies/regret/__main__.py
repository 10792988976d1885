"""Measure how far `best`, which knows no truth, is behind the best of fixed settings, with the truth at hand.

    python -m studies.regret --objects foot chest --finer 1 2 --photons 0 10000
    python -m studies.regret --objects walnut htc2022 --views 15 30 60
    python -m studies.regret --objects foot --clouds

Simulated scans are cone beams over a full turn, with 4 as the largest line integral, of objects on --finer times as many voxels
a side as are reconstructed. Settings are ASD-POCS, and the refinement of `best` with 20 passes on the scan's voxels and on half
their size; with --clouds, which takes minutes a scan, also the volume of a cloud and what starts from it. Each is stored when it
is done; the same command goes on after an interruption. The table, as Markdown, is updated after each, with its provenance.
Seconds are CPU seconds of all cores together; for settings with a cloud they include the fit.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable
from studies.command import run_study, updated_table


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--objects', nargs='+', default=['foot', 'chest'], metavar='NAME', help='(default: foot chest)')
    p.add_argument('--finer', nargs='+', type=int, metavar='N', help='(default: 1 2; for measured scans 1)')
    p.add_argument('--views', nargs='+', type=int, default=[25], metavar='N', help='(default: 25)')
    p.add_argument(
        '--photons', nargs='+', type=float, default=[0.0], metavar='N', help='photons a pixel (default: 0, no noise)'
    )
    p.add_argument('--size', type=int, default=48, help='voxels along the longest side (default: 48)')
    p.add_argument('--clouds', action='store_true', help='also the settings that need a fitted cloud')
    p.add_argument('--out', type=Path, default=Path('out/regret'), help='folder of the results')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> None:
    args = arguments()
    ranges = (('--finer', args.finer or (), 1, 8), ('--views', args.views, 4, 5000), ('--size', [args.size], 12, 512))
    for name, values, low, high in ranges:
        if not all(low <= value <= high for value in values):
            raise InputError(f'{name} must be from {low} to {high}, not {" ".join(map(str, values))}')
    if not all(value == 0 or 1 <= value <= 1e12 for value in args.photons):
        raise InputError(f'--photons must be 0, or from 1 to 1e12, not {" ".join(map(str, args.photons))}')
    use_variant(args.variant)
    from lingo_mi.validation.tables.objects import available
    from studies.regret.study import MEASURED, Case, Study

    simulated = [name for name in args.objects if name not in MEASURED]
    names = [*(available(simulated, print) if simulated else []), *(n for n in args.objects if n in MEASURED)]
    require_writable(args.out, args.out, 'choose another --out')
    study = Study(args.out, args.size)
    cases = [
        Case(n, f, v, p)
        for n in names
        for f in (args.finer or ((1,) if n in MEASURED else (1, 2)))
        for v in args.views
        for p in args.photons
    ]
    for case in cases:
        study.check(case)
    with updated_table(args.out / 'regret.md', lambda: study.table(cases)) as update:
        study.compute_missing(cases, args.clouds, update)


if __name__ == '__main__':
    run_study('regret', main)
