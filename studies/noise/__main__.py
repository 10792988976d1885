"""Measure what an early stop and weights of the pixels are worth to a fit of noisy projections.

    python -m studies.noise --objects foot chest engine --photons 1000 10000 100000
    python -m studies.noise --objects foot --photons 1000 --finer 1 2 --settings equal stopped

Simulated scans are cone beams over a full turn, with 4 as the largest line integral, of objects on --finer times as many voxels
a side as are reconstructed. The method is fast: all its steps, with the volume compared with the truth every 50; stopped by views
that it holds out; and with pixels weighed by the noise's standard deviation. Each fit is stored when it is done; the
same command goes on after an interruption. The table, as Markdown, is updated after each, with its provenance.
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
    p.add_argument(
        '--photons',
        nargs='+',
        type=float,
        default=[1e3, 1e4, 1e5],
        metavar='N',
        help='photons a pixel (default: 1e3 1e4 1e5)',
    )
    p.add_argument('--finer', nargs='+', type=int, default=[2], metavar='N', help='(default: 2)')
    p.add_argument('--views', type=int, default=25, metavar='N', help='(default: 25)')
    p.add_argument('--settings', nargs='+', metavar='NAME', help='some of equal, stopped, noise (default: all)')
    p.add_argument('--size', type=int, default=64, help='voxels along the longest side (default: 64)')
    p.add_argument('--pixels', type=int, default=64, help='pixels along a side of the panel (default: 64)')
    p.add_argument('--iterations', type=int, metavar='N', help="steps of a fit, at most (default: the method's)")
    p.add_argument('--out', type=Path, default=Path('out/noise'), help='folder of the results')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> None:
    args = arguments()
    ranges = (
        ('--photons', args.photons, 1, 1e12),
        ('--finer', args.finer, 1, 8),
        ('--views', [args.views], 4, 5000),
        ('--size', [args.size], 12, 512),
        ('--pixels', [args.pixels], 12, 2048),
        ('--iterations', [] if args.iterations is None else [args.iterations], 50, 1_000_000),
    )
    for name, values, low, high in ranges:
        if not all(low <= value <= high for value in values):
            raise InputError(f'{name} must be from {low} to {high:g}, not {" ".join(map(str, values))}')
    use_variant(args.variant)
    from lingo_mi.fitting.methods.fast import Fast
    from lingo_mi.validation.tables.objects import available
    from studies.noise.study import SETTINGS, Case, Study

    settings = args.settings or list(SETTINGS)
    for name in settings:
        if name not in SETTINGS:
            raise InputError(f'--settings {name}: is unknown; use some of {", ".join(SETTINGS)}')
    names = available(args.objects, print)
    require_writable(args.out, args.out, 'choose another --out')
    study = Study(args.out, args.size, args.pixels, args.iterations or Fast.iterations)
    cases = [Case(n, p, f, args.views) for f in args.finer for n in names for p in args.photons]
    with updated_table(args.out / 'noise.md', lambda: study.table(cases)) as update:
        study.compute_missing(cases, settings, update)


if __name__ == '__main__':
    run_study('noise', main)
