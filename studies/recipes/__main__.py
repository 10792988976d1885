"""Compare methods: quality against time, for every scene and method, as curves and a table.

    python -m studies.recipes x3d_foot chest x3d_engine
    python -m studies.recipes x3d_foot --methods fast r2 --views 25 --iterations 5000
    python -m studies.recipes x3d_foot --methods lingo r2 lingo:start=fdk r2:start=masks -D pixels=256 -D pixel_size=2

A method may be followed by options that differ (`METHOD:name=value,name=value`): so each part of a method can be
exchanged alone.

Runs `lingo-mi fit` for each combination that has no result yet in --out (an interrupted one goes on where it stopped), then
draws all histories and prints a Markdown table, which it writes to --out as recipes.md, too, with recipes.provenance.json
beside it. --iterations is for all but fast, which keeps its own number.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.fitting.methods.by_name import CLOUDS, METHODS
from lingo_mi.storage.file_access import require_writable, write_text
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('scenes', nargs='+', type=Path, metavar='SCENE', help='a scene file, or the name of a shipped one')
    p.add_argument(
        '--methods',
        nargs='+',
        default=list(CLOUDS),
        metavar='METHOD[:name=value,...]',
        help=f'any of {", ".join(METHODS)} (default: {" ".join(CLOUDS)})',
    )
    p.add_argument('--views', type=int, default=25)
    p.add_argument('--iterations', type=int, default=5000)
    p.add_argument(
        '-D',
        dest='define',
        action='append',
        default=[],
        metavar='name=value',
        help='for every fit, see lingo-mi fit --help',
    )
    p.add_argument('--out', type=Path, default=Path('out/recipes'), help='folder of the results')
    p.add_argument('--figure', type=Path, help='picture of the curves (default: recipes.png in --out)')
    return p.parse_args()


def main() -> None:
    args = arguments()
    from lingo_mi.validation.cuda_model import beside
    from lingo_mi.validation.provenance import write_provenance
    from studies.recipes.comparison import Comparison, draw, recipe_table

    require_writable(args.out, args.out, 'choose another --out')
    if args.figure:
        require_writable(args.figure.parent, args.figure, 'choose another --figure')
    comparison = Comparison(args.out, args.views, args.iterations, tuple(args.define))
    results = comparison.results(args.scenes, args.methods)
    text = recipe_table(results)
    print(text)
    for (scene, method), metrics in results.items():
        if str(metrics.get('variant')).startswith('cuda'):
            print(beside(f'{scene}, {method}, a step', 'step', metrics['ms_per_iteration'] / 1e3, metrics['gaussians']))
    path = args.out / 'recipes.md'
    write_text(path, text + '\n')
    write_provenance(path)
    draw(results, args.figure or args.out / 'recipes.png')


if __name__ == '__main__':
    run_study('recipes', main)
