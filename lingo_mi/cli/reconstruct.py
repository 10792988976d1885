"""Reconstruct a CT volume from projections, measured or simulated, or completed from a fit.

    lingo-mi reconstruct x3d_foot --algorithm fdk
    lingo-mi reconstruct x3d_foot --algorithm asd-pocs --views 25 -D niter=20 --out foot.nii.gz
    lingo-mi reconstruct x3d_foot --algorithm sart --complete out/x3d_foot --views 100
    lingo-mi reconstruct x3d_foot --algorithm voxelize --complete out/x3d_foot
    lingo-mi reconstruct x3d_foot --algorithm refined --complete out/x3d_foot --views 100
    lingo-mi reconstruct x3d_foot --algorithm refined --start out/x3d_foot
    lingo-mi reconstruct large.npy --algorithm fdk --slab 64 --out large.ome.zarr
    lingo-mi reconstruct large.npy --algorithm fdk --cluster local:3 --out large.ome.zarr
    lingo-mi reconstruct x3d_foot --algorithm best --views 25 --report foot.html

The input is the same as for `lingo-mi fit`. If the true volume is known, PSNR and SSIM are printed twice: the full scale is
its largest density, and then 1.

    --complete   makes the volume from the fitted views and from views that the fit renders, --views in all; the scan must be on
                 a circle, with an upright panel and no invalid pixel
    --start      starts refined or an iterative algorithm from the fit's volume, and uses the fitted views of any scan
    refined      is the best for few clean views; it starts from the fit's volume, and fits all views first and then the measured
                 ones; for objects finer than the voxels, add -D finer=2
    best         chooses its settings by measured views that it holds out, and needs no fit; with -D cloud=true, it also fits a
                 cloud, and tries to start from it

best prints its trials, and writes them beside the volume V.nii.gz as V-plan.json. V-error.nii.gz shows where the volume is least
certain, and is a layer of the page that --report writes.

All algorithms but fdk use the poses that the fit has corrected. Beam hardening and scatter that the scene's tube names are
taken out of the projections first, unless -D effects=ignore is given. With --complete and --start, these are the effects that
the fit has modelled.

A volume larger than memory is made and written in slabs of --slab slices, by fdk, sart, os-sart, sirt, asd-pocs and voxelize.
Until it is written, the iterative ones hold it in a folder beside it, whose name ends in .slabs. If they are stopped, the same
command goes on. With --cluster, workers make the slabs and write them to an .ome.zarr; they must see its folder.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from lingo_mi.api.volumes import reconstruct
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
from lingo_mi.common.parsing import parse
from lingo_mi.common.runtime import use_variant
from lingo_mi.completion.prepare import require_volume
from lingo_mi.files.slabs import THICKNESS, check_volume_name, plan_and_error_map, require_whole_chunks
from lingo_mi.files.units import unit_of
from lingo_mi.fitting.fit import Fit, load_fit
from lingo_mi.fitting.measure import volume_quality
from lingo_mi.geometry import Geometry, Grid
from lingo_mi.reconstruction import ALGORITHMS, Algorithm, Prior, Reconstruction
from lingo_mi.reconstruction.best import Chosen
from lingo_mi.reconstruction.preconditions import require_rays
from lingo_mi.reconstruction.run import check_room
from lingo_mi.report.data import ReportData
from lingo_mi.report.page import report_page
from lingo_mi.report.view import Page
from lingo_mi.scene.load import defaults, load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.storage.file_access import check_new_file, require_writable
from lingo_mi.storage.folder_lock import writing_file

IN_SLABS = 'fdk', 'sart', 'os-sart', 'sirt', 'asd-pocs', 'voxelize'  # these need not hold the whole volume


def parser() -> Parser:
    p = Parser(description=__doc__)
    input_arguments(p)
    p.add_argument('--algorithm', choices=(*ALGORITHMS, 'voxelize'), default='fdk', help='(default: fdk)')
    p.add_argument(
        '--views',
        type=int,
        metavar='N',
        help='use N evenly spaced views (default: all); with --complete: measured and rendered ones together',
    )
    p.add_argument(
        '--complete',
        metavar='F',
        help='folder of a fit, its result.xml or checkpoint.npz, from which missing views of a circle are rendered',
    )
    p.add_argument(
        '--start', metavar='F', help='the same for a fit: refined or an iterative algorithm starts from its volume'
    )
    p.add_argument(
        '--out',
        type=Path,
        metavar='F',
        help='the volume: NIfTI, .nii or .nii.gz, OME-Zarr, .ome.zarr, or a folder of DICOM slices, .dicom '
        '(default: out/<scene>-<algorithm>.nii.gz)',
    )
    p.add_argument(
        '--slab',
        type=int,
        metavar='N',
        help=f'hold N slices of the volume in memory at once ({", ".join(IN_SLABS)}; default: all)',
    )
    p.add_argument(
        '--cluster',
        metavar='ADDRESS|local:N',
        help="let a Dask cluster make the slabs and write them to an .ome.zarr: its scheduler's address or file, or N processes "
        'of this machine',
    )
    p.add_argument(
        '--report',
        type=Path,
        metavar='F.html',
        help="a page with the volume's slices, the truth if known, and the map of errors",
    )
    p.add_argument('--force', action='store_true', help='replace an earlier volume')
    p.add_argument(
        '--seed',
        type=int,
        metavar='N',
        help="seed of a simulated detector's noise (default: 0; with --complete and --start the seed of the fit)",
    )
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument(
        '-D',
        dest='define',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='a parameter of the algorithm, such as niter, lmbda, tviter or filter (see lingo_mi.reconstruction), or of '
        'the scene file; effects=ignore takes projections for line integrals',
    )
    return p


def check_arguments(args: argparse.Namespace) -> None:
    """Raises InputError if the arguments contradict each other."""
    check_input(args)
    if args.seed is not None:
        check_seed(args.seed)
    name, fit = args.algorithm, args.complete or args.start
    given = ' and '.join(f'--{option}' for option in ('slab', 'cluster') if getattr(args, option) is not None)
    if args.cluster is not None and args.slab is None:
        args.slab = THICKNESS
    if args.slab is not None and args.report is not None:
        raise InputError(f'--report needs the whole volume: leave out {given}')
    if args.slab is not None and args.slab < 1:
        raise InputError(f'--slab is a number of slices from 1 on, not {args.slab}')
    if args.slab is not None and name not in IN_SLABS:
        raise InputError(
            f'--algorithm {name} needs the whole volume: leave out {given}, or choose {", ".join(IN_SLABS)}'
        )
    if args.slab is not None and args.start:
        raise InputError(f'a volume in slabs starts empty: leave out --start, or {given}')
    if name == 'best' and fit:
        raise InputError(
            '--algorithm best chooses by measured views, which a fit has seen already: leave out --complete and --start'
        )
    if name == 'refined' and not fit:
        raise InputError('--algorithm refined needs a fit: name its folder with --complete or --start')
    if name == 'voxelize' and (args.views or not args.complete):
        raise InputError('--algorithm voxelize samples a fit: name its folder with --complete, and leave out --views')
    if args.complete and not args.views and name != 'voxelize':
        raise InputError('--complete needs --views, the number of measured and rendered views together')
    if args.start and (args.complete or args.views or name in ('fdk', 'voxelize')):
        raise InputError(
            '--start is for an iterative --algorithm and the views of its fit: leave out --complete and --views'
        )


def check_output(out: Path, args: argparse.Namespace) -> None:
    """Raises InputError if a file cannot be written, or would spoil one."""
    unit = unit_of(**units_of(args))
    check_volume_name(out, unit)
    if args.cluster is not None:
        require_whole_chunks(out, args.slab, unit)
    for path in (out, *(plan_and_error_map(out) if args.algorithm == 'best' else ())):
        check_new_file(path, args.force)
    if (page := args.report) is None:
        return
    if page.suffix.lower() not in ('.html', '.htm'):
        raise InputError(f'{page}: a report is a page; give a --report that ends in .html')
    if page.is_symlink() or page.exists() and not args.force:
        raise InputError(f'{page}: exists already; add --force to replace it, or choose another --report')
    require_writable(page.parent, page, 'choose another --report')


def algorithm_of(args: argparse.Namespace, values: dict[str, str]) -> Algorithm | None:
    """The algorithm with the -D values of its options, which have the types of their defaults; None: voxelize."""
    name, algorithm = args.algorithm, ALGORITHMS.get(args.algorithm)
    accepted = {k: v for k, v in algorithm().options.items() if not isinstance(v, Prior)} if algorithm else {}
    options: dict = {}
    for option, text in values.items():
        if option not in accepted:
            raise InputError(
                f'-D {option}: neither a parameter of the scene nor of {name} ({", ".join(accepted) or "it has none"})'
            )
        options[option] = parse(f'-D {option}', text, 0.0 if accepted[option] is None else accepted[option])
    if args.start and options.get('completed_niter'):
        raise InputError('-D completed_niter must be 0 with --start, which completes no views: leave it out')
    return algorithm(**options) if algorithm else None


def main() -> None:
    args = parser().parse_args()
    use_variant(args.variant)
    check_arguments(args)
    args.scene = scene_path(args.scene)
    defined, scene_parameters = definitions(args.define), defaults(args.scene)
    options = {k: v for k, v in defined.items() if k not in scene_parameters}
    effects = options.pop('effects', 'model')
    if effects not in ('model', 'ignore') or effects == 'ignore' and (args.complete or args.start):
        raise InputError(
            f"-D effects={effects}: must be 'model' or 'ignore', and with --complete or --start goes by the fit"
        )
    algorithm = algorithm_of(args, options)
    out = args.out or Path('out') / f'{input_name(args)}-{args.algorithm}.nii.gz'
    check_output(out, args)
    with writing_file(out):  # before the work: this refuses a file that another process writes
        pass
    scene = load_scene(args.scene, {k: v for k, v in defined.items() if k in scene_parameters}, args.slab or 0)
    fit = load_fit(args.complete or args.start) if args.complete or args.start else None
    if fit is not None and (args.start or args.algorithm in ('refined', 'voxelize')):
        require_volume(fit)
    measured = 0 if fit is None else len(fit.nominal_geometry)
    if not (args.projections or args.volume):  # their geometry is not known before they are read
        require_rays(scene.scanner.geometry)
        if not args.slab:
            check_room(scene.scanner.geometry, algorithm, args.views or measured)
    seed, views = (0, args.views) if fit is None else (fit.checkpoint.seed, None)  # a fit chooses its views
    seed = seed if args.seed is None else args.seed
    dataset = read_input(args, scene, views, seed, args.slab or 0)
    if effects == 'ignore':
        dataset = replace(dataset, train=replace(dataset.train, effects=None))
    began = time.perf_counter()
    if algorithm is None:
        assert fit is not None  # see `check_arguments`
        result = voxelized(fit, dataset.train.geometry.grid, out, args)
    else:
        total = args.views if args.complete else None
        result = reconstruct(
            dataset,
            algorithm,
            start=fit,
            views=total,
            out=out,
            slab=args.slab,
            cluster=args.cluster,
            force=args.force,
            **units_of(args),
        )
    if isinstance(result, Path):
        shape = ' x '.join(map(str, dataset.train.geometry.grid.shape))
        seconds = time.perf_counter() - began
        print(f'{args.algorithm}, {shape} voxels in slabs of {args.slab} slices: {seconds:.1f} s\n{out}')
    else:
        scanner = dataset.train.geometry
        views = measured or len(scanner)
        completed = args.complete and args.algorithm != 'refined'  # `refined` fits the measured views last
        of = f'a fit to {views}' if args.algorithm == 'voxelize' else str(args.views if completed else views)
        show(result, of, views, scanner, dataset.volume, out, args)


def voxelized(fit: Fit, grid: Grid, out: Path, args: argparse.Namespace) -> Reconstruction | Path:
    """Write the fit's own volume on the scan's voxels."""
    with writing_file(out):
        if args.slab:
            return fit.save_volume(out, grid, slab=args.slab, cluster=args.cluster, force=args.force, **units_of(args))
        began = time.perf_counter()
        result = Reconstruction(fit.volume(grid), [], time.perf_counter() - began, grid)
        result.save(out, force=args.force, **units_of(args))
        return result


def show(
    result: Reconstruction,
    of: str,
    measured: int,
    scanner: Geometry,
    truth: np.ndarray | None,
    out: Path,
    args: argparse.Namespace,
) -> None:
    """Print how a volume was made of views, and how good it is; write the page. measured: how many of them were."""
    missed = ''
    if result.residuals:
        missed = f', |A x - b| / |b| = {result.residuals[-1]:.4g} after {len(result.residuals) - 1} iterations'
    print(f'{args.algorithm} of {of} views: {result.seconds:.1f} s{missed}')
    if result.grid != scanner.grid:
        truth = None  # it has other voxels
    numbers = {} if truth is None else result.metrics(truth)
    if numbers:
        print(volume_quality(numbers))
    print(out)
    if args.report is not None:
        data = ReportData(
            title=f'{input_name(args)}, {args.algorithm}',
            metrics=numbers | dict(method=args.algorithm, views=measured, seconds=result.seconds),
            volume=result.volume,
            truth=truth,
            spacing=result.grid.spacing,
            centre=result.grid.centre,
            scanner=scanner,
            error_map=result.error if isinstance(result, Chosen) else None,
            command=command_line(),
        )
        print(Page(report_page(data)).save(args.report, force=args.force))
    if isinstance(result, Chosen):
        print(result.report())
