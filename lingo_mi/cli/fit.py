"""Fit a cloud of 3D Gaussians, or a neural field, to a CT scan, and make a volume and new views of it.

    lingo-mi fit x3d_foot
    lingo-mi fit x3d_foot --recipe lingo --views 25 --iterations 5000
    lingo-mi fit chest --volume my_ct.nii.gz --views 25
    lingo-mi fit foot_50.pickle

The scene says what is scanned and by which scanner; the projections are rendered from its object. A file of measured ones takes
its place, or with --projections that of the object alone, where a scene's tube and detector are to be modelled. A cloud is
initialised from the projections, fitted, and written to the output folder with a report (report.html), a volume in mm
(volume.nii.gz), the Gaussians (gaussians.ply), a scene of them (result.xml), held-out views and metrics.json. The baselines 3dgs
and xgaussian make neither volume nor scene; naf makes no Gaussians, and a scene of its volume.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import (
    Parser,
    check_input,
    check_seed,
    command_line,
    definitions,
    input_arguments,
    input_name,
    read_input,
    writable_folder,
)
from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import nearest
from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.recipes import settings_of
from lingo_mi.fitting.settings import Settings
from lingo_mi.scene.shipped import scene_path
from lingo_mi.storage.folder_lock import locked
from lingo_mi.storage.output_folder import CHECKPOINT, CLOUD, METRICS, PAGE, SCENE, VOLUME, clear_leftovers


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    input_arguments(p)
    p.add_argument(
        '--recipe',
        '--method',
        default='fast',
        metavar='R',
        help='fast (default), the published lingo and r2, or the baselines 3dgs and xgaussian, which '
        'composite opacities and make views but no volume, and naf, a neural field; R:setting=value,... changes it',
    )
    p.add_argument('--views', type=int, metavar='N', help='fit N evenly spaced views (default: all)')
    p.add_argument('--iterations', type=int, metavar='N', help="Adam steps (default: the recipe's)")
    p.add_argument(
        '--init',
        choices=('edges', 'lingo', 'r2', 'random', 'cuboid', 'network'),
        help='initial cloud: edges of a volume of SART (edges), Otsu masks (lingo) or an FDK '
        'volume (r2); of 3dgs and xgaussian: random points or a regular grid (cuboid); of naf: network',
    )
    p.add_argument('--out', type=Path, metavar='D', help='output folder (default: out/<scene>)')
    p.add_argument(
        '--live', action='store_true', help='serve a page that grows while the fit runs, to this machine alone'
    )
    p.add_argument(
        '--log-dir',
        type=Path,
        metavar='D',
        help="write TensorBoard's events: numbers, slices, views (extra: tensorboard)",
    )
    p.add_argument('--resume', action='store_true', help='go on from the checkpoint in the output folder')
    p.add_argument('--force', action='store_true', help='replace an earlier result')
    p.add_argument('--seed', type=int, default=0, metavar='N', help='of every random choice (default: 0)')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument(
        '-D',
        dest='define',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='any setting of the fit (see lingo_mi.fitting.settings), or a parameter of the scene file',
    )
    return p.parse_args()


def main() -> None:
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.scene.load import defaults

    check_input(args)
    check_seed(args.seed)
    defined = definitions(args.define)
    args.scene = scene_path(args.scene)
    own = defaults(args.scene)  # a name of the scene goes before a setting's
    given = {k: v for k, v in defined.items() if k not in own}
    options = {k: v for k, v in (('iterations', args.iterations), ('init', args.init)) if v is not None}
    if twice := given.keys() & options.keys():
        raise InputError(f'--{min(twice)} and -D {min(twice)} say the same: leave one of them out')
    given |= options
    known = settings_of(args.recipe).flat()
    if unknown := [k for k in given if k not in known]:
        names = ', '.join(sorted(own)) or 'it has none'
        raise InputError(
            f'-D {unknown[0]}: neither a parameter of {args.scene} ({names}) nor a setting of the fit'
            + (nearest(unknown[0], [*own, *known]) or '; the documentation of Settings lists those')
        )
    settings = settings_of(args.recipe, **given)
    folder = writable_folder(args.out or Path('out') / input_name(args), args.force, args.resume)
    with locked(folder):
        clear_leftovers(folder)
        fit_scene(folder, args, settings, {k: v for k, v in defined.items() if k in own})


def fit_scene(folder: Path, args: argparse.Namespace, settings: Settings, parameters: dict[str, str]) -> None:
    """Fit, and write the result into a folder that no other process writes to.

    parameters   of the scene file
    """
    from lingo_mi.common.progress import Progress
    from lingo_mi.results.fit_into import fit_into
    from lingo_mi.results.measure import summary
    from lingo_mi.results.watchers import watchers_of
    from lingo_mi.scene.load import load_scene

    scene = load_scene(args.scene, parameters)
    scan = read_input(args, scene, args.views, args.seed)
    title = Path(args.volume or args.projections or scene.name).name
    watchers = watchers_of(scan.train.geometry, args.live, args.log_dir, title)
    with Progress('Fit', settings.iterations) as bar:
        try:
            result = fit_into(
                folder,
                scan,
                settings,
                args.seed,
                bar.update,
                resume=args.resume,
                title=title,
                method=args.recipe,
                command=command_line(without=('--resume', '--force')),
                watchers=watchers,
            )
        except KeyboardInterrupt:
            begun = (folder / CHECKPOINT).exists()
            again = command_line(*['--resume'] * begun, without=('--resume', '--force'))
            raise KeyboardInterrupt(f'go on with  {again}') from None
    print(summary(result))
    written = [name for name in (PAGE, VOLUME, CLOUD, SCENE, METRICS) if (folder / name).exists()]
    print(f'{folder}/: {", ".join(written)}')
