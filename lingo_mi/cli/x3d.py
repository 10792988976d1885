"""Make the paper's Tables 1 to 3 from X3D's scans in a folder: pickles of SAX-NeRF and NAF, and folders of R2-Gaussian.

    lingo-mi x3d x3d/
    lingo-mi x3d x3d/ --tables views --scenes foot chest --views 25
    lingo-mi x3d x3d/ --tables scenes --methods r2 lingo
    lingo-mi x3d x3d/ --cluster tcp://head-node:8786

The tables are views (Table 1: new views), ct (Table 2: CT reconstruction in two stages), ablation (Table 3: the parts of LINGO),
controls (further rows of Table 3, which separate what the loss scale does from the larger number of Gaussians that it causes),
and scenes (volumes from all 50 views, beside published ones). A scene is named after its file: foot_50.pickle is foot.

All 15 scenes need a GPU or a cluster. Each fit and each reconstruction is stored as soon as it is done. After any interruption
the same command goes on, and other tables use what is there. A table, as Markdown and JSON, is updated after each of them.
TABLE.provenance.json beside it says how it was made. --record keeps the numbers of all cells in one file, from which a table
can be continued on another machine without the checkpoints.
"""

from dataclasses import replace
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.cli.paper_tables import check_table_arguments, make_tables, table_arguments
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant

TABLES = 'views', 'ct', 'ablation', 'controls', 'scenes'


def parser() -> Parser:
    p = Parser(description=__doc__)
    p.add_argument('folder', type=Path, metavar='DIR', help='with pickles NAME_50.pickle, and folders of R2-Gaussian')
    p.add_argument(
        '--tables', nargs='+', choices=TABLES, default=list(TABLES[:3]), metavar='T', help='any of views, ct, ablation, '
        'controls, scenes (default: views ct ablation)',
    )  # fmt: skip
    p.add_argument('--scenes', nargs='+', metavar='NAME', help='scans to use (default: all in the folder)')
    p.add_argument('--out', type=Path, metavar='D', help='folder of the results (default: out/tables/<name of DIR>)')
    table_arguments(p)
    return p


def main() -> None:
    args = parser().parse_args()
    use_variant(args.variant)
    from lingo_mi.validation.tables.cells import SCALES
    from lingo_mi.validation.tables.objects import scans_in

    check_table_arguments(args)
    there = scans_in(args.folder)
    if missing := [wanted for wanted in args.scenes or () if wanted not in there]:
        raise InputError(f'{args.folder}: there is no scan {missing[0]!r}; it has {", ".join(there)}')
    scale = replace(SCALES['paper'], first=args.first, data=str(args.folder))
    folder = args.out or Path('out/tables') / args.folder.resolve().name
    tables = list(dict.fromkeys(args.tables))
    make_tables(args, tables, scale, 'paper', list(dict.fromkeys(args.scenes or there)), folder)
