"""Regenerate the paper's tables: new views, CT reconstruction in two stages, and the parts of LINGO.

    lingo-mi tables views
    lingo-mi tables ct --objects foot chest --views 25
    lingo-mi tables ablation --scale paper
    lingo-mi tables scenes --data x3d/

Objects are the phantoms foot and chest and the volumes aneurism, engine, teapot, tooth, chest_lidc0314, abdomen_ts, aorta_ts,
head_fsrt and jaw_fsrt, as NAME.nii.gz in the folder that LINGO_MI_DATA names; those that are missing are skipped. With --data,
they are the scans in a folder: pickles of SAX-NeRF and X3D, and folders of R2-Gaussian.

views and ct are Tables 1 and 2 of the paper, ablation is Table 3. controls are further rows of it, which separate what the loss
scale does from the larger number of Gaussians that it causes. scenes compares the volumes of all views with published ones.

Scale small has 96 voxels and 192 pixels a side, fits of 5000 iterations from 5, 10 and 25 views, and of the objects foot, chest,
engine and aneurism. It takes a night on two cores: 5 hours for views and ct together, by the times stored in their cells, and 1
more for the ablation; half an hour (aneurism) to two hours (chest) an object. Scale paper has the paper's 256 voxels, 512 pixels
and 30,000 iterations, and of the objects also chest_lidc0314 and head_fsrt; it is meant for a GPU.

Each fit and each reconstruction is stored as soon as it is done. After any interruption the same command goes on, and other
tables use what is there. The table, as Markdown and JSON, is renewed after every one of them, with TABLE.provenance.json beside
it, which says how. --record keeps the numbers of all cells in one file, from which a table can be continued on another machine
without the checkpoints. With --cluster, cells are computed side by side on the workers of a Dask cluster.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from lingo_mi.cli.common import Parser, check_seed, check_threads, cluster_arguments, runner_of
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.methods.by_name import METHODS, method_of
from lingo_mi.storage.file_access import leftovers, require_writable
from lingo_mi.storage.folder_lock import locked

ALGORITHMS = 'fdk', 'sart', 'asd-pocs', 'refined', 'voxelize', 'finer', 'best'
PUBLISHED = '3dgs', 'xgaussian', 'r2', 'lingo'  # the columns of the paper


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('table', choices=('views', 'ct', 'ablation', 'controls', 'scenes'))
    p.add_argument('--objects', nargs='+', metavar='NAME', help='(default: those of the scale)')
    p.add_argument('--data', type=Path, metavar='D', help='a folder of scans that take the place of the objects')
    p.add_argument(
        '--views',
        nargs='+',
        type=int,
        metavar='N',
        help='fitted, of 50 (default: 5 10 25; ablation and controls: 25; scenes: 50)',
    )
    p.add_argument('--first', action='store_true', help='fit the first views instead of evenly spaced ones')
    p.add_argument(
        '--iterations',
        nargs='+',
        type=int,
        metavar='N',
        help='of the fits; ct and ablation take the largest (default: small 5000, paper 5000 15000 30000)',
    )
    p.add_argument(
        '--methods',
        nargs='+',
        default=list(PUBLISHED),
        metavar='METHOD[:name=value,...]',
        help=f'columns of views and ct: any of {", ".join(METHODS)}, with options that differ (default: '
        f'{" ".join(PUBLISHED)}, as in the paper)',
    )
    p.add_argument(
        '--algorithms',
        nargs='+',
        choices=ALGORITHMS,
        default=list(ALGORITHMS[:-2]),
        metavar='A',
        help=f'rows of ct, of {", ".join(ALGORITHMS)} (default: all but the last two)',
    )
    p.add_argument('--scale', choices=('small', 'paper'), help='see above (default: small; with --data paper)')
    p.add_argument(
        '--finer',
        type=int,
        default=1,
        metavar='N',
        help='scan N times as many voxels along each side, where an '
        'object has them, so that projections hold what the voxels cannot (default: 1)',
    )
    p.add_argument(
        '--photons',
        type=float,
        default=0.0,
        metavar='N',
        help='a pixel in the open beam, of fitted views (default: no noise)',
    )
    p.add_argument(
        '--electronic-noise', type=float, default=0.0, metavar='S', help='standard deviation, in photons (default: 0)'
    )
    p.add_argument(
        '--longest',
        type=float,
        default=4.0,
        metavar='P',
        help='line integral of a scan, to which its density is scaled when photons are counted (default: 4). '
        "R2-Gaussian's noise is --photons 1e5 --electronic-noise 10 --longest 1",
    )
    p.add_argument(
        '--seeds',
        nargs='+',
        type=int,
        default=[0],
        metavar='N',
        help='of every random choice; a table has the means over several seeds and their spread (default: 0)',
    )
    p.add_argument('--out', type=Path, metavar='D', help='folder of the results (default: out/tables/<scale>)')
    p.add_argument('--record', type=Path, metavar='F.json', help='a file that keeps the numbers of all cells')
    cluster_arguments(p)
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p.parse_args()


def main() -> None:
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.studies.simulated import counting
    from lingo_mi.studies.tables.cells import SCALES, SCANNED, Cells
    from lingo_mi.studies.tables.objects import available, scans_in
    from lingo_mi.studies.tables.record import Record
    from lingo_mi.studies.tables.report import groups, plan

    name = args.scale or ('small' if args.data is None else 'paper')
    scale = replace(
        SCALES[name],
        finer=args.finer,
        photons=args.photons,
        electronic_noise=args.electronic_noise,
        longest=args.longest,
        first=args.first,
        data='' if args.data is None else str(args.data),
    )
    usual = {'ablation': (25,), 'controls': (25,), 'scenes': (SCANNED,)}
    views = sorted(set(args.views or usual.get(args.table, (5, 10, 25))))
    iterations = sorted(set(args.iterations or scale.iterations))
    if views[0] < 1 or views[-1] > SCANNED:
        raise InputError(f'--views must be from 1 to {SCANNED}, not {" ".join(map(str, views))}')
    if iterations[0] < 1:
        raise InputError(f'--iterations must be at least 1, not {iterations[0]}')
    seeds = list(dict.fromkeys(args.seeds))
    for seed in seeds:
        check_seed(seed, '--seeds')
    if args.finer < 1:
        raise InputError(f'--finer must be at least 1, not {args.finer}')
    counting(args.photons, args.electronic_noise)  # checks them
    if not 0 < args.longest < 100:
        raise InputError(f'--longest must be above 0 and below 100, not {args.longest:g}')
    for method in args.methods:
        method_of(method)
    if args.data is None:
        objects = available(dict.fromkeys(args.objects or scale.objects), print)
    else:
        if args.scale or args.finer > 1 or args.photons:
            raise InputError('--data has scans as they are: leave out --scale, --finer and --photons')
        there = scans_in(args.data)
        if missing := [wanted for wanted in args.objects or () if wanted not in there]:
            raise InputError(f'{args.data}: there is no scan {missing[0]!r}; it has {", ".join(there)}')
        objects = list(dict.fromkeys(args.objects or there))
    folder = args.out or Path('out/tables') / (name if args.data is None else args.data.resolve().name)
    if folder.exists() and not folder.is_dir():
        raise InputError(f'{folder}: is a file, not a folder; choose another --out')
    require_writable(folder, folder, 'choose another --out')
    check_threads(args)
    record = None
    if args.record is not None:
        record = Record(args.record)
        require_writable(args.record.parent, args.record, 'choose another --record')
    every = [Cells(folder, scale, seed, record=record) for seed in seeds]
    rows = groups(args.table, views, iterations, args.methods, args.algorithms)
    if not plan(rows, objects):
        raise InputError(
            f'{" and ".join(args.algorithms)} cannot make a volume of {" and ".join(args.methods)}: opacities '
            'are no densities; add other --algorithms or --methods'
        )
    with locked(folder):
        compute(args, every, rows, objects, name)


def compute(args: argparse.Namespace, every: list, rows: list, objects: list[str], name: str) -> None:
    """Compute what is missing of a table's cells, and write the table, in a folder that no other process writes to."""
    from lingo_mi.studies.tables.report import plan, write
    from lingo_mi.studies.tables.series import compute_missing

    folder = every[0].folder
    for inside in (folder, *(path for path in folder.rglob('*') if path.is_dir())):
        for leftover, _ in leftovers(inside):  # the lock is ours, so nobody is writing them
            leftover.unlink(missing_ok=True)
    planned = plan(rows, objects)

    def renew():
        write(args.table, rows, objects, every, name)

    failed: list[tuple[Any, Any]] = []
    for cells in every:
        if args.cluster is None:
            failed += cells.compute_missing(planned, renew).items()
        else:
            folder.mkdir(parents=True, exist_ok=True)
            with runner_of(args, folder) as runner:
                failed += compute_missing(cells, planned, runner, renew).items()
    print(write(args.table, rows, objects, every, name))
    print(f'{folder}/: {args.table}.md, {args.table}.json, {args.table}.provenance.json')
    if failed:
        cell, error = failed[0]
        raise InputError(f'{len(failed)} of {len(planned) * len(every)} cells failed, the first one ({cell}): {error}')
