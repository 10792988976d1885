"""Regenerate the paper's tables on simulated scans: new views, CT reconstruction in two stages, and the parts of LINGO.

    python -m studies.tables views
    python -m studies.tables ct --objects foot chest --views 25
    python -m studies.tables ablation --scale paper

Objects are the phantoms foot, chest and shepp_logan and the volumes aneurism, engine, teapot, tooth, chest_lidc0314,
abdomen_ts, aorta_ts, head_fsrt and jaw_fsrt, as NAME.nii.gz in the folder that LINGO_MI_DATA names; those that are missing are
skipped. From X3D's own scans, `lingo-mi x3d` makes the tables.

views and ct are Tables 1 and 2 of the paper, ablation is Table 3. controls are further rows of it, which separate what the loss
scale does from the larger number of Gaussians that it causes.

Scale small has 96 voxels and 192 pixels a side, fits of 5000 iterations from 5, 10 and 25 views, and of the objects foot, chest,
engine and aneurism. It takes a night on two cores: 5 hours for views and ct together, by the times stored in their cells, and 1
more for the ablation; half an hour (aneurism) to two hours (chest) an object. Scale paper has the paper's 256 voxels, 512 pixels
and 30,000 iterations, and of the objects also chest_lidc0314 and head_fsrt; it is meant for a GPU.

Each fit and each reconstruction is stored as soon as it is done. After any interruption the same command goes on, and other
tables use what is there. The table, as Markdown and JSON, is updated after every one of them, with TABLE.provenance.json beside
it, which says how. --record keeps the numbers of all cells in one file, from which a table can be continued on another machine
without the checkpoints. With --cluster, cells are computed side by side on the workers of a Dask cluster.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.cli.paper_tables import PUBLISHED, check_table_arguments, make_tables, table_arguments
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('table', choices=('views', 'ct', 'ablation', 'controls'))
    p.add_argument('--objects', nargs='+', metavar='NAME', help='(default: the objects of the scale)')
    p.add_argument('--scale', choices=('small', 'paper'), default='small', help='see above (default: small)')
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
        help='photons a pixel in the open beam, for the fitted views (default: no noise)',
    )
    p.add_argument(
        '--electronic-noise',
        type=float,
        default=0.0,
        metavar='S',
        help='its standard deviation, in photons (default: 0)',
    )
    p.add_argument(
        '--longest',
        type=float,
        default=4.0,
        metavar='P',
        help='line integral of a scan, to which its density is scaled when photons are counted (default: 4). '
        "R2-Gaussian's noise is --photons 1e5 --electronic-noise 10 --longest 1",
    )
    p.add_argument('--out', type=Path, metavar='D', help='folder of the results (default: out/tables/<scale>)')
    table_arguments(p)
    return p.parse_args()


def main() -> None:
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.validation.tables.cells import SCALES
    from lingo_mi.validation.tables.objects import available
    from lingo_mi.validation.tables.photons import counting

    check_table_arguments(args)
    if args.table in ('ablation', 'controls') and args.methods != list(PUBLISHED):
        raise InputError(
            f'--methods has no effect on {args.table}, whose rows are fixed; the table views takes any methods'
        )
    if args.finer < 1:
        raise InputError(f'--finer must be at least 1, not {args.finer}')
    counting(args.photons, args.electronic_noise)  # checks them
    if not 0 < args.longest < 100:
        raise InputError(f'--longest must be above 0 and below 100, not {args.longest:g}')
    scale = replace(
        SCALES[args.scale],
        finer=args.finer,
        photons=args.photons,
        electronic_noise=args.electronic_noise,
        longest=args.longest,
        first=args.first,
    )
    objects = available(dict.fromkeys(args.objects or scale.objects), print)
    make_tables(args, [args.table], scale, args.scale, objects, args.out or Path('out/tables') / args.scale)


if __name__ == '__main__':
    run_study('tables', main)
