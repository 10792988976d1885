"""Fit a cloud of 3D Gaussians, or a neural field, to a CT scan, and make a volume and new views of it.

    lingo-mi fit x3d_foot
    lingo-mi fit x3d_foot --method lingo --views 25 --iterations 5000
    lingo-mi fit chest --volume my_ct.nii.gz --views 25
    lingo-mi fit foot_50.pickle

The scene says what is scanned and by which scanner; the projections are rendered from its object. A file of measured
projections replaces the scene. With --projections, it replaces only the object, and the scene's tube and detector are modelled.
A cloud is started from the projections, fitted, and written to the output folder with a report (report.html), a volume in mm
(volume.nii.gz), the Gaussians (gaussians.ply), a scene of them (result.xml), held-out views and metrics.json. The baselines
3dgs and xgaussian make neither volume nor scene. naf makes no Gaussians, and its scene holds its volume.
"""

import argparse
from collections.abc import Collection
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
    units_of,
)
from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import nearest
from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.method import Method
from lingo_mi.fitting.methods.by_name import known_options, method_of
from lingo_mi.scene.shipped import scene_path
from lingo_mi.storage.folder_lock import locked
from lingo_mi.storage.output_folder import CHECKPOINT, CLOUD, METRICS, PAGE, SCENE, VOLUME, result_folder


def parser() -> Parser:
    p = Parser(description=__doc__)
    input_arguments(p)
    p.add_argument(
        '--method',
        default='fast',
        metavar='M',
        help='fast (default), the published lingo or r2, naf (a neural field), or the baselines 3dgs and xgaussian, which '
        'composite opacities and make views but no volume; M:option=value,... changes options',
    )
    p.add_argument('--views', type=int, metavar='N', help='fit N evenly spaced views (default: all)')
    p.add_argument(
        '--hold-out',
        type=int,
        metavar='N',
        help='hold one view in N out of the fit, to measure how well unseen views are predicted; 0: fit all (default: 10 for '
        'measured scans of 20 views or more, else 0)',
    )
    p.add_argument('--iterations', type=int, metavar='N', help="Adam steps (default: the method's)")
    p.add_argument(
        '--start',
        metavar='S',
        help='where the Gaussians start: edges of a volume of SART (edges), Otsu masks (masks) or an FDK volume (fdk); for 3dgs '
        'and xgaussian also random points (random) or a regular grid (cuboid)',
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
    p.add_argument(
        '--cluster',
        metavar='ADDRESS|local:N',
        help="divide the views of a step (-D batch=N) among the workers of a Dask cluster: its scheduler's address or file, or N "
        'processes of this machine',
    )
    p.add_argument('--resume', action='store_true', help='go on from the checkpoint in the output folder')
    p.add_argument('--force', action='store_true', help='replace an earlier result')
    p.add_argument('--seed', type=int, default=0, metavar='N', help='seed of every random choice (default: 0)')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument(
        '-D',
        dest='define',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='any option of the method (see lingo_mi.fitting.methods), or a parameter of the scene file',
    )
    return p


def main() -> None:
    args = parser().parse_args()
    use_variant(args.variant)
    from lingo_mi.scene.load import defaults

    check_input(args)
    check_seed(args.seed)
    defined = definitions(args.define)
    args.scene = scene_path(args.scene)
    scene_parameters = defaults(args.scene)  # a parameter of the scene comes before an option of the same name
    method = method_of_arguments(
        args, {k: v for k, v in defined.items() if k not in scene_parameters}, scene_parameters
    )
    if args.cluster is not None:  # before the scan is simulated
        method.require_batch()
    folder = result_folder(args.out or Path('out') / input_name(args), force=args.force, resume=args.resume)
    fit_scene(folder, args, method, {k: v for k, v in defined.items() if k in scene_parameters})


def method_of_arguments(args: argparse.Namespace, values: dict[str, str], of_scene: Collection[str]) -> Method:
    """The method of --method, --iterations, --start and the -D values that are not the scene's."""
    options = {k: v for k, v in (('iterations', args.iterations), ('start', args.start)) if v is not None}
    if twice := values.keys() & options.keys():
        raise InputError(f'--{min(twice)} and -D {min(twice)} say the same: leave one of them out')
    options |= values
    accepted = known_options(args.method, options)
    if unknown := [name for name in values if name not in accepted]:
        names = ', '.join(sorted(of_scene)) or 'it has none'
        raise InputError(
            f'-D {unknown[0]}: neither a parameter of {args.scene} ({names}) nor an option of {args.method}'
            + (nearest(unknown[0], [*of_scene, *accepted]) or '; the documentation of the methods lists those')
        )
    return method_of(args.method, **options)


def fit_scene(folder: Path, args: argparse.Namespace, method: Method, parameters: dict[str, str]) -> None:
    """Fit, write the result into the folder, and print what it is worth.

    Parameters
    ----------
    parameters : dict[str, str]
        Parameters of the scene file.
    """
    from lingo_mi.api.fitting import fit
    from lingo_mi.fitting.measure import summary
    from lingo_mi.scene.load import load_scene

    with locked(folder):  # before the work: this refuses a folder that another process writes
        scene = load_scene(args.scene, parameters)
    scan = read_input(args, scene, args.views, args.seed)
    try:
        result = fit(
            scan,
            method,
            hold_out=args.hold_out,
            seed=args.seed,
            folder=folder,
            resume=args.resume,
            force=args.force,
            title=Path(args.volume or args.projections or scene.name).name,
            live=args.live,
            log_dir=args.log_dir,
            cluster=args.cluster,
            **units_of(args),
            note=dict(command=command_line(without=('--resume', '--force'))),
        )
    except KeyboardInterrupt:
        begun = (folder / CHECKPOINT).exists()
        again = command_line(*['--resume'] * begun, without=('--resume', '--force'))
        raise KeyboardInterrupt(f'go on with  {again}') from None
    print(summary(result.numbers))
    if scan.test is None and result.data is not None and result.data.test is not None:
        held = len(result.data.test)
        print(f'{held} of the {len(scan.train)} views were held out to measure the fit; --hold-out 0 fits them, too')
    written = [name for name in (PAGE, VOLUME, CLOUD, SCENE, METRICS) if (folder / name).exists()]
    print(f'{folder}/: {", ".join(written)}')
