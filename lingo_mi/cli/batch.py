"""Fit a cohort: a list of scans, one a row, each into a folder of its own, with a table of all results.

    lingo-mi batch cohort.csv --method fast --out out/cohort
    lingo-mi batch cohort.csv --out out/cohort --cluster local:4
    lingo-mi batch cohort.csv --out out/cohort --cluster tcp://head-node:8786

The list is a CSV file whose first line names its columns; an empty cell is the default, and paths begin from the list's folder:

    file       projections, as for `lingo-mi fit --projections`; with a scene in geometry, a CT volume for its scanner
    geometry   the geometry file (.yml) of an .npy; or a scene, .xml or a shipped one, whose own object is scanned without a file
    name       of the folder in --out (default: the name of the file)
    method, views, seed, mu_water   as for `lingo-mi fit`
    any option of the row's method, such as iterations or lambda_tv, or parameter of its scene

The whole list is checked first: every row that cannot be used gets a line, and nothing is begun. Then each scan is fitted into
--out/NAME, and results.csv (and results.parquet, with pyarrow) gets a row of every number. A scan that fails is tried once more
when all others have ended. The same command goes on after any interruption: what is done stays, a fit that was begun continues
from its checkpoint.

With --cluster, scans are fitted side by side on the workers of a Dask cluster, each with one GPU or some threads of the CPU.
"""

import argparse
import sys
from pathlib import Path

from lingo_mi.cli.common import Parser, cluster_arguments, runner_of
from lingo_mi.common.errors import InputError, brief
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable
from lingo_mi.storage.folder_lock import locked

SHOWN = 'psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d', 'gaussians', 'seconds_fit'


def parser() -> Parser:
    p = Parser(description=__doc__)
    p.add_argument('list', type=Path, metavar='LIST.csv', help='the scans, see above')
    p.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder of the results')
    p.add_argument(
        '--method',
        default='fast',
        metavar='M',
        help='method of rows that name none: METHOD[:option=value,...] (default: fast)',
    )
    cluster_arguments(p)
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p


def main() -> None:
    args = parser().parse_args()
    from lingo_mi.cohort.listing import BadList, read_list
    from lingo_mi.cohort.run import done_already
    from lingo_mi.cohort.table import CSV
    from lingo_mi.fitting.methods.by_name import method_of

    method_of(args.method)
    out = args.out
    if out.exists() and not out.is_dir():
        raise InputError(f'{out}: is a file, not a folder; choose another --out')
    if args.list.resolve() == (out / CSV).resolve():
        raise InputError(f'{args.list}: is the table that this command writes; choose another --out')
    use_variant(args.variant)  # reading scenes needs one
    try:
        rows = read_list(args.list, args.method)
        require_writable(out, out, 'choose another --out')
        with locked(out):
            run_batch(args, rows, done_already(rows, out))
    except BadList as error:
        for line in error.lines:
            print(f'error: {brief(line)}', file=sys.stderr)
        raise


def run_batch(args: argparse.Namespace, rows: list, done: dict) -> None:
    """Fit what is not done, in a folder that no other batch writes to, and say what came of it."""
    from lingo_mi.cohort.run import run_cohort

    if done:
        print(f'{len(done)} of {len(rows)} scans are done already')
    with runner_of(args, args.out) as runner:
        table = run_cohort(rows, args.out, runner, done)
    width = max(len(row.name) for row in rows)
    print(f'{"":{width}s}  ' + '  '.join(f'{name:>11s}' for name in SHOWN))
    for name, numbers in table.numbers.items():
        values = (numbers.get(key) for key in SHOWN)
        print(f'{name:{width}s}  ' + '  '.join(f'{"" if v is None else f"{v:.6g}":>11s}' for v in values))
    for name, line in table.failed.items():
        print(f'failed: {name}: {line}', file=sys.stderr)
    print(', '.join(map(str, table.files)))
    if table.failed:
        raise InputError(f'{len(table.failed)} of {len(rows)} scans failed twice; the same command tries them again')
