"""Measure which errors of a scanner explain what a reconstruction leaves of a measured scan.

    python -m studies.explain walnut_cone.npz --views 30
    python -m studies.explain htc2022_fan.npz --views 60 --binning 2
    python -m studies.explain walnut_cone.npz --views 30 --correct drift
    python -m studies.explain walnut_cone.npz --views 30 --with-cloud

Calibrates the views that are kept, adds what was found kind by kind, and compares predictions of the other views with what was
measured. Writes rms.md, its provenance, rms.json and residuals.png, the differences in one held-out view, to a folder of --out
with the name of the scan and of the options. A row is stored when it is done: the same command goes on.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable
from lingo_mi.storage.folder_lock import locked
from studies.command import run_study

KINDS = 'drift', 'air', 'gain', 'curve', 'scatter'


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('scan', help='a measured scan, views in the order in which they were taken')
    p.add_argument('--views', type=int, default=30, metavar='N', help='evenly spaced views to keep (default 30)')
    p.add_argument('--binning', type=int, default=1, metavar='N', help='N x N pixels, and voxels, as one (default 1)')
    p.add_argument(
        '--with-cloud',
        action='store_true',
        help='show instead the corrections that fits of the method fast find with the cloud',
    )
    p.add_argument(
        '--correct',
        nargs='*',
        choices=KINDS,
        metavar='KIND',
        help=f'what to seek beside the axis and the turn of the panel: {", ".join(KINDS)} (default: all)',
    )
    p.add_argument('--iterations', type=int, metavar='N', help="iterations of these fits (default: the method's)")
    p.add_argument(
        '--out',
        type=Path,
        default=Path('out/explain'),
        metavar='D',
        help='where the folder is made (default: out/explain)',
    )
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> None:
    args = arguments()
    require_writable(args.out, args.out, 'choose another --out')
    if args.binning < 1:
        raise InputError(f'--binning must be at least 1, not {args.binning}')
    if args.with_cloud and args.correct is not None:
        raise InputError('--correct is for corrections before a reconstruction; leave it out with --with-cloud')
    if args.iterations is not None and not args.with_cloud:
        raise InputError('--iterations goes with --with-cloud')
    use_variant(args.variant)
    from lingo_mi.api.data import load
    from studies.explain.residuals import binned, cloud_rows, find, report, rows

    dataset = load(args.scan, views=args.views)
    if dataset.test is None:
        raise InputError(f'{args.scan}: no view is held out: give fewer --views')
    dataset = binned(dataset, args.binning)
    kinds = KINDS if args.correct is None else args.correct
    options = [f'{args.views}_views', *[f'binned_{args.binning}'] * (args.binning > 1)]
    options += ['with_cloud'] if args.with_cloud else sorted(kinds)
    folder = args.out / '_'.join([Path(args.scan).stem, *options])
    with locked(folder):
        if args.with_cloud:
            options = {} if args.iterations is None else dict(iterations=args.iterations)
            print(report(list(cloud_rows(dataset, folder, **options)), folder, 'found with the cloud'))
        else:
            calibration = find(dataset, kinds)
            print('\n'.join(calibration.lines()))
            print(report(list(rows(dataset, calibration, folder)), folder, 'corrected'))
    print(f'{folder}/: rms.md, rms.json, residuals.png')


if __name__ == '__main__':
    run_study('explain', main)
