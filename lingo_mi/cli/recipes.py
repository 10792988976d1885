"""Compare recipes: quality against time, for every scene and method, as curves and a table.

    python scripts/recipes.py scenes/x3d_foot.xml scenes/chest.xml scenes/x3d_engine.xml
    python scripts/recipes.py scenes/x3d_foot.xml --methods fast r2 --views 25 --iterations 5000
    python scripts/recipes.py scenes/x3d_foot.xml --methods lingo r2 lingo:init=r2 r2:init=lingo -D pixels=256 -D pixel_size=2

A method may be followed by settings that differ (`METHOD:name=value,name=value`): so each part of a recipe can be
exchanged alone.

Runs scripts/fit.py for each combination that has no result yet in --out (an interrupted one goes on where it stopped), then
draws all histories and prints a Markdown table. --iterations is for all but fast, which keeps its own number.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.errors import InputError
from lingo_mi.fit.recipes import METHODS, VOLUMETRIC, settings_of

COLUMNS = (
    ('psnr_2d', 'views, dB', '{:.2f}'),
    ('psnr_2d_r2', 'views (R2), dB', '{:.2f}'),
    ('ssim_2d', 'SSIM', '{:.4f}'),
    ('psnr_3d', 'volume, dB', '{:.2f}'),
    ('ssim_3d', 'SSIM 3D', '{:.4f}'),
    ('ipsd', 'IPSD', '{:.4f}'),
    ('ipsd_targets', 'born', '{:,}'),
    ('gaussians', 'Gaussians', '{:,}'),
    ('iterations', 'iterations', '{}'),
    ('seconds_init', 'init, s', '{:.1f}'),
    ('seconds_fit', 'fit, s', '{:.0f}'),
)


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('scenes', nargs='+', type=Path)
    p.add_argument(
        '--methods',
        nargs='+',
        default=list(VOLUMETRIC),
        metavar='METHOD[:name=value,...]',
        help=f'any of {", ".join(METHODS)} (default: {" ".join(VOLUMETRIC)})',
    )
    p.add_argument('--views', type=int, default=25)
    p.add_argument('--iterations', type=int, default=5000)
    p.add_argument(
        '-D', dest='define', action='append', default=[], metavar='name=value', help='for every fit, see fit.py'
    )
    p.add_argument('--out', type=Path, default=Path('out/recipes'), help='folder of the results')
    p.add_argument('--figure', type=Path, help='picture of the curves (default: recipes.png in --out)')
    return p.parse_args()


def result(scene, method, args) -> dict:
    """The metrics of one fit, run now unless they are there."""
    name, _, changes = method.partition(':')
    changes = [*args.define, *filter(None, changes.split(','))]
    if name != 'fast' and not any(change.startswith('iterations=') for change in changes):
        changes.append(f'iterations={args.iterations}')
    folder = args.out / '_'.join([scene.stem, str(args.views), name, *changes])
    if not (folder / 'metrics.json').exists():
        command = [
            sys.executable,
            '-m',
            'lingo_mi',
            'fit',
            str(scene),
            '--method',
            name,
            '--views',
            str(args.views),
            '--out',
            str(folder),
        ]
        command += [word for change in changes for word in ('-D', change)]
        command += ['--resume'] if (folder / 'checkpoint.npz').exists() else []
        print(' '.join(command), file=sys.stderr)
        if code := subprocess.run(command).returncode:
            raise InputError(f'{scene}: fit.py --method {method} failed with exit code {code}')
    return json.loads((folder / 'metrics.json').read_text())


def draw(results, figure):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(scene for scene, _ in results))
    fig = Figure(figsize=(5 * len(scenes), 7), layout='constrained')
    FigureCanvasAgg(fig)
    axes = fig.subplots(2, len(scenes), squeeze=False)
    for (scene, method), metrics in results.items():
        for row, key in enumerate(('psnr_2d', 'psnr_3d')):
            axis = axes[row, scenes.index(scene)]
            points = [(e['seconds'], e[key]) for e in metrics['history'] if e.get(key) is not None]
            if not points:  # 3dgs and xgaussian make no volume
                continue
            axis.semilogx(*zip(*points), '.-', label=f'{method}, {metrics["iterations"]} iterations')
            axis.set(
                title=scene if row == 0 else None,
                xlabel='time in steps [s]',
                ylabel=f'PSNR, {"held-out views" if row == 0 else "volume"} [dB]',
            )
            axis.grid(alpha=0.3, which='both')
            axis.legend()
    figure.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(figure, dpi=90)


def main():
    args = arguments()
    for method in args.methods:
        settings_of(method)
    results = {(scene.stem, method): result(scene, method, args) for scene in args.scenes for method in args.methods}
    print('| scene | method | ' + ' | '.join(title for _, title, _ in COLUMNS) + ' |')
    print('|---|---|' + '---:|' * len(COLUMNS))
    for (scene, method), metrics in results.items():
        cells = (form.format(metrics[key]) if metrics[key] is not None else '–' for key, _, form in COLUMNS)
        print(f'| {scene} | {method} | ' + ' | '.join(cells) + ' |')
    draw(results, args.figure or args.out / 'recipes.png')
