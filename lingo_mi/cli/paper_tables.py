"""Helpers of the commands that make the paper's tables: their arguments, and the cells that are still missing."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lingo_mi.cli.common import check_seed, check_threads, cluster_arguments, runner_of
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.methods.by_name import METHODS, method_of
from lingo_mi.storage.file_access import leftovers, require_writable
from lingo_mi.storage.folder_lock import locked

if TYPE_CHECKING:
    from lingo_mi.validation.tables.cells import Scale

ALGORITHMS = 'fdk', 'sart', 'asd-pocs', 'refined', 'voxelize', 'finer', 'best', 'sart-r2', 'asd-pocs-r2'
PUBLISHED = '3dgs', 'xgaussian', 'r2', 'lingo'  # the columns of the paper


def table_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say what a table has: views, methods, algorithms, seeds, and where it is written."""
    parser.add_argument(
        '--views',
        nargs='+',
        type=int,
        metavar='N',
        help='views to fit, of 50 (default: 5 10 25; ablation and controls: 25; scenes: 50)',
    )
    parser.add_argument('--first', action='store_true', help='fit the first views instead of evenly spaced ones')
    parser.add_argument(
        '--iterations',
        nargs='+',
        type=int,
        metavar='N',
        help='iterations of the fits; ct and ablation take the largest (default: 5000 15000 30000; scale small: 5000)',
    )
    parser.add_argument(
        '--methods',
        nargs='+',
        default=list(PUBLISHED),
        metavar='METHOD[:name=value,...]',
        help=f'columns of views and ct: any of {", ".join(METHODS)}, with options that differ (default: '
        f'{" ".join(PUBLISHED)}, as in the paper)',
    )
    parser.add_argument(
        '--algorithms',
        nargs='+',
        choices=ALGORITHMS,
        default=list(ALGORITHMS[:5]),
        metavar='A',
        help=f'rows of ct, of {", ".join(ALGORITHMS)} (default: the first five); the last two have the options that '
        'R2-Gaussian has released',
    )
    parser.add_argument(
        '--seeds',
        nargs='+',
        type=int,
        default=[0],
        metavar='N',
        help='seeds of every random choice; a table has the means over several seeds and their spread (default: 0)',
    )
    parser.add_argument('--record', type=Path, metavar='F.json', help='a file that keeps the numbers of all cells')
    cluster_arguments(parser)
    parser.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')


def check_table_arguments(args: argparse.Namespace) -> None:
    """Raises InputError for arguments of `table_arguments` out of their ranges."""
    from lingo_mi.validation.tables.cells import SCANNED

    if not all(1 <= views <= SCANNED for views in args.views or ()):
        raise InputError(f'--views must be from 1 to {SCANNED}, not {" ".join(map(str, args.views))}')
    if not all(number >= 1 for number in args.iterations or ()):
        raise InputError(f'--iterations must be at least 1, not {" ".join(map(str, args.iterations))}')
    for seed in args.seeds:
        check_seed(seed, '--seeds')
    for method in args.methods:
        method_of(method)
    check_threads(args)


def make_tables(
    args: argparse.Namespace, tables: Sequence[str], scale: Scale, name: str, objects: Sequence[str], folder: Path
) -> None:
    """Compute the cells of some tables that are not stored yet, and write these tables, in a folder of their own.

    Parameters
    ----------
    args : argparse.Namespace
        As `table_arguments` added them, checked.
    tables : Sequence[str]
        Names of `report.TITLES`.
    name : str
        Name of the scale.
    objects : Sequence[str]
        Names of objects, or of the scans in scale.data.

    Raises
    ------
    InputError
        After everything else is done, if cells could not be computed.
    """
    from lingo_mi.validation.tables.cells import SCANNED, Cells
    from lingo_mi.validation.tables.record import Record
    from lingo_mi.validation.tables.report import groups, plan

    if folder.exists() and not folder.is_dir():
        raise InputError(f'{folder}: is a file, not a folder; choose another --out')
    require_writable(folder, folder, 'choose another --out')
    record = None
    if args.record is not None:
        record = Record(args.record)
        require_writable(args.record.parent, args.record, 'choose another --record')
    every = [Cells(folder, scale, seed, record=record) for seed in dict.fromkeys(args.seeds)]
    iterations = sorted(set(args.iterations or scale.iterations))
    usual = {'ablation': (25,), 'controls': (25,), 'scenes': (SCANNED,)}
    rows = {}
    for table in tables:
        views = sorted(set(args.views or usual.get(table, (5, 10, 25))))
        rows[table] = groups(table, views, iterations, args.methods, args.algorithms)
        if not plan(rows[table], objects):
            raise InputError(
                f'{" and ".join(args.algorithms)} cannot make a volume of {" and ".join(args.methods)}: opacities '
                'are not densities; add other --algorithms or --methods'
            )
    with locked(folder):
        failed = [failure for table in tables for failure in _make(args, table, every, rows[table], objects, name)]
    if failed:
        cell, error, planned = failed[0]
        raise InputError(f'{len(failed)} of {planned} cells failed, the first one ({cell}): {error}')


def _make(
    args: argparse.Namespace, table: str, every: list, rows: list, objects: Sequence[str], name: str
) -> list[tuple[Any, Any, int]]:
    """Make one table in a folder that no other process writes to.

    Returns
    -------
    list[tuple[Any, Any, int]]
        The cells that failed, each with its error and the number of cells of the table.
    """
    from lingo_mi.validation.tables.report import plan, write
    from lingo_mi.validation.tables.series import compute_missing

    folder = every[0].folder
    for inside in (folder, *(path for path in folder.rglob('*') if path.is_dir())):
        for leftover, _ in leftovers(inside):  # the lock is ours, so nobody is writing them
            leftover.unlink(missing_ok=True)
    planned = plan(rows, objects)

    def update():
        write(table, rows, objects, every, name)

    failed: list[tuple[Any, Any]] = []
    for cells in every:
        if args.cluster is None:
            failed += cells.compute_missing(planned, update).items()
        else:
            folder.mkdir(parents=True, exist_ok=True)
            with runner_of(args, folder) as runner:
                failed += compute_missing(cells, planned, runner, update).items()
    print(write(table, rows, objects, every, name))
    print(f'{folder}/: {table}.md, {table}.json, {table}.provenance.json')
    return [(cell, error, len(planned) * len(every)) for cell, error in failed]
