"""Reconstruct a CT volume from projections, measured or simulated, or completed from a fitted cloud.

    lingo-mi reconstruct x3d_foot --algorithm fdk
    lingo-mi reconstruct x3d_foot --algorithm asd-pocs --views 25 -D niter=20 --out foot.nii.gz
    lingo-mi reconstruct x3d_foot --algorithm sart --complete out/x3d_foot/result.xml --views 100
    lingo-mi reconstruct x3d_foot --algorithm voxelize --complete out/x3d_foot/result.xml
    lingo-mi reconstruct x3d_foot --algorithm refined --complete out/x3d_foot/result.xml --views 100
    lingo-mi reconstruct x3d_foot --algorithm refined --start out/x3d_foot/result.xml
    lingo-mi reconstruct large.npy --algorithm fdk --slab 64 --out large.ome.zarr
    lingo-mi reconstruct x3d_foot --algorithm best --views 25 --report foot.html

The input is what `lingo-mi fit` takes. With --complete, the views that the cloud was fitted to are kept, those missing to --views
are rendered from it, and the volume is made of both; the scan must be one on a circle, before an upright panel, with every
pixel. refined, which is the best for few clean views, starts from the cloud's own volume, meets all views first and the
measured ones then; for objects finer than the voxels add -D finer=2. With --start, the volume is made of the views that the
cloud was fitted to, by refined or an iterative algorithm, from the cloud's own volume; any scan will do. Poses that the fit
has corrected are used as it has left them, but not by fdk. Where the true volume is known, PSNR and SSIM are printed, with
its largest density for full scale, then with 1.
best chooses its settings by measured views that it holds out, and needs no cloud; with
-D cloud=true it also fits one, and tries to start from it. What it tried is printed, and written beside
the volume V.nii.gz as V-plan.json; V-error.nii.gz shows where the volume is least certain, and is a layer of the page that
--report writes.
Beam hardening and scatter that the scene's tube names are taken out of the projections first, unless -D effects=ignore is
given; with --complete and --start, those that the fit has modelled.

A volume larger than memory is made and written in slabs of --slab slices, by fdk, sart, os-sart, sirt and voxelize. The iterative
ones keep it in a folder beside it, whose name is that of the volume and .slabs, until it is written. Where they were stopped, the
same command goes on.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from lingo_mi.cli.common import (
    Parser,
    check_input,
    check_seed,
    command_line,
    definitions,
    input_arguments,
    input_name,
    read_input,
    writable_file,
    writing_file,
)
from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import parse
from lingo_mi.common.progress import Progress
from lingo_mi.common.runtime import use_variant
from lingo_mi.completion.clouds import FittedCloud, load_cloud
from lingo_mi.completion.prepare import fit_cloud, prepare_completed, prepare_start, sampled
from lingo_mi.files.slabs import NIFTI, ZARR, plan_and_error_map, write_slabs
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.reconstruction import ALGORITHMS, FDK, Algorithm, Best, Reconstruction, progress_bar, reconstruct
from lingo_mi.reconstruction.best import Chosen
from lingo_mi.reconstruction.effects_correction import linearised
from lingo_mi.reconstruction.preconditions import require_rays, require_signal
from lingo_mi.reconstruction.run import check_room, mask_images
from lingo_mi.reconstruction.sart import Sweeps
from lingo_mi.reconstruction.slab_sweeps import discard
from lingo_mi.report.data import ReportData
from lingo_mi.report.page import report_page
from lingo_mi.results.measure import volume_quality
from lingo_mi.scan import Dataset, Scan
from lingo_mi.scene.checks import thinned
from lingo_mi.scene.load import LoadedScene, defaults, load_scene
from lingo_mi.scene.shipped import scene_path
from lingo_mi.storage.file_access import optional, require_writable, write_text

FROM_CLOUD = 'refined', 'voxelize'  # algorithms that nothing can be done by without a cloud
IN_SLABS = 'fdk', 'sart', 'os-sart', 'sirt', 'voxelize'  # those that need not hold the whole volume


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
        help='result.xml of a fit, from which missing views of a circle are rendered; '
        'checkpoint.npz of one by naf, 3dgs or xgaussian',
    )
    p.add_argument(
        '--start',
        metavar='F',
        help='result.xml of a fit, or checkpoint.npz of one by naf, whose volume refined or an iterative algorithm starts from',
    )
    p.add_argument(
        '--out',
        type=Path,
        metavar='F',
        help='the volume: NIfTI, .nii or .nii.gz, or OME-Zarr, .ome.zarr (default: out/<scene>-<algorithm>.nii.gz)',
    )
    p.add_argument(
        '--slab',
        type=int,
        metavar='N',
        help='hold N slices of the volume in memory at once (fdk, sart, os-sart, sirt, voxelize; default: all)',
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
        help="of a simulated detector's noise (default: 0; with --complete and --start that of the fit)",
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
    return p.parse_args()


def output(path: Path, force: bool) -> Path:
    """The output file, if it can be written without spoiling one."""
    if not path.name.endswith((*NIFTI, *ZARR)):
        raise InputError(
            f'{path}: volumes are written as NIfTI or OME-Zarr; give an --out that ends in .nii, .nii.gz or .ome.zarr'
        )
    if path.name.endswith(ZARR):
        optional('zarr', 'ome-zarr')
    return writable_file(path, force)


def check_page(path: Path, force: bool) -> None:
    """Raises InputError where the page cannot be written, or would spoil a file."""
    if path.suffix.lower() not in ('.html', '.htm'):
        raise InputError(f'{path}: a report is a page; give a --report that ends in .html')
    if path.is_symlink() or path.exists() and not force:
        raise InputError(f'{path}: exists already; add --force to replace it, or choose another --report')
    require_writable(path.parent, path, 'choose another --report')


def check_arguments(args: argparse.Namespace) -> None:
    """Raises InputError where the arguments contradict each other."""
    check_input(args)
    if args.seed is not None:
        check_seed(args.seed)
    if args.slab is not None and args.report is not None:
        raise InputError('--report needs the whole volume: leave out --slab')
    if args.slab is not None and (args.slab < 1 or args.algorithm not in IN_SLABS):
        raise InputError(f'--slab is a number of slices from 1 on, for --algorithm {", ".join(IN_SLABS)}')
    if args.slab is not None and args.start:
        raise InputError('--slab starts from an empty volume: leave out --start, or --slab')
    if args.algorithm == 'best' and (args.complete or args.start):
        raise InputError(
            '--algorithm best chooses by measured views, which a fitted cloud has seen already: leave out --complete and --start'
        )
    if args.algorithm in FROM_CLOUD and not (args.complete or args.start and args.algorithm == 'refined'):
        raise InputError(
            f'--algorithm {args.algorithm} needs a fitted cloud: name its result.xml with --complete'
            + (' or --start' if args.algorithm == 'refined' else '')
        )
    if args.algorithm == 'voxelize' and args.views:
        raise InputError('--algorithm voxelize makes its volume of the cloud alone: leave out --views')
    if args.complete and not args.views and args.algorithm != 'voxelize':
        raise InputError('--complete needs --views, the number of measured and rendered views together')
    if args.start and (args.complete or args.views or args.algorithm in ('fdk', 'voxelize')):
        raise InputError(
            '--start is for an iterative --algorithm and the views of its fit: leave out --complete and --views'
        )


def algorithm_of(name: str, given: dict[str, str]) -> Algorithm | None:
    """The algorithm of this name with the -D values of its options, which have the types of their defaults; None: voxelize."""
    made = ALGORITHMS.get(name)
    known, options = made().options if made else {}, {}
    for option, text in given.items():
        if option not in known:
            raise InputError(
                f'-D {option}: neither a parameter of the scene nor of {name} ({", ".join(known) or "it has none"})'
            )
        options[option] = parse(f'-D {option}', text, 0.0 if known[option] is None else known[option])
    return made(**options) if made else None


def main() -> None:
    args = arguments()
    use_variant(args.variant)
    check_arguments(args)
    args.scene = scene_path(args.scene)
    defined, own = definitions(args.define), defaults(args.scene)
    chosen = {k: v for k, v in defined.items() if k not in own}
    effects = chosen.pop('effects', 'model')
    if effects not in ('model', 'ignore') or effects == 'ignore' and (args.complete or args.start):
        raise InputError(
            f"-D effects={effects}: must be 'model' or 'ignore', and with --complete or --start goes by the fit"
        )
    if args.start and args.algorithm == 'refined':  # there are no completed views
        chosen = dict(completed_niter='0') | chosen
    algorithm = algorithm_of(args.algorithm, chosen)
    out = output(args.out or Path('out') / f'{input_name(args)}-{args.algorithm}.nii.gz', args.force)
    if args.algorithm == 'best':
        for path in plan_and_error_map(out):
            writable_file(path, args.force)
    if args.report is not None:
        check_page(args.report, args.force)
    with writing_file(out):
        reconstruct_into(out, args, algorithm, effects, {k: v for k, v in defined.items() if k in own})


def reconstruct_into(
    out: Path, args: argparse.Namespace, algorithm: Algorithm | None, effects: str, parameters: dict[str, str]
) -> None:
    """Reconstruct, and write the volume into a file that no other process writes.

    effects      'model' or 'ignore'
    parameters   of the scene file
    """
    scene = load_scene(args.scene, parameters, args.slab or 0)
    cloud = cloud_of(args)
    dataset = read_dataset(args, scene, cloud, algorithm)
    if algorithm is None:
        assert cloud is not None  # as `check_arguments` has made sure
        sample_cloud(out, cloud, dataset, args)
        return
    require_signal(dataset.train)
    scan, inputs = prepared(dataset, cloud, algorithm, args, effects)
    if args.slab:
        make_in_slabs(out, scan, algorithm, args)
        return
    with progress_bar(algorithm, scan) as progress:
        found = reconstruct(scan, algorithm, progress=progress, **inputs)
    measured = len(cloud.geometry if cloud and args.complete else scan)
    write_volume(out, found, str(len(scan)), measured, dataset.volume, args)
    if isinstance(found, Chosen):
        print(found.report())
        plan, error = plan_and_error_map(out)
        replace(found, volume=found.error).save(error, force=True)
        write_text(plan, json.dumps(found.record(), indent=1) + '\n')  # last: it says whose the map is


def cloud_of(args: argparse.Namespace) -> Fitted | FittedCloud | None:
    """The fit that --complete or --start names. Raises InputError where it has no volume and the algorithm needs one."""
    path = args.complete or args.start
    cloud = load_cloud(path) if path else None
    opacities = isinstance(cloud, Fitted) and not cloud.settings.volumetric
    if (args.algorithm in FROM_CLOUD or args.start) and opacities:
        raise InputError(
            f'{path}: this recipe fits opacities, not densities, and has no volume; '
            + ('leave out --start' if args.start else 'take another --algorithm')
        )
    return cloud


def read_dataset(
    args: argparse.Namespace, scene: LoadedScene, cloud: Fitted | FittedCloud | None, algorithm: Algorithm | None
) -> Dataset:
    """The projections, if there is room for what is made of them."""
    slab: int = args.slab or 0
    seed = getattr(cloud, 'seed', None) if args.seed is None else args.seed
    views = args.views or (len(cloud.geometry) if cloud else None)
    if not (args.projections or args.volume):  # their geometry is not known before they are read
        require_rays(scene.scanner.geometry)
        if not slab:
            check_room(scene.scanner.geometry, algorithm, views)
    dataset = read_input(args, scene, None if cloud else args.views, seed or 0, slab)
    scan = dataset.train
    require_rays(scan.geometry)
    if not (slab and isinstance(algorithm, Sweeps | FDK)):  # whose `slabs` knows better
        grid = thinned(scan.geometry, slab)
        both = args.start and dataset.volume is not None  # a start and the truth, of which the needs have one
        check_room(grid, algorithm, views, mask_images(scan) + (4 * prod(grid.nVoxel) if both else 0))
    return dataset


def prepared(
    dataset: Dataset, cloud: Fitted | FittedCloud | None, algorithm: Algorithm, args: argparse.Namespace, effects: str
) -> tuple[Scan, dict[str, Any]]:
    """The views that a volume is made of, and what else its algorithm is given."""
    if cloud and args.complete:
        return prepare_completed(dataset, cloud, args.views, algorithm)
    if cloud:
        return prepare_start(dataset, cloud, algorithm)
    scan = dataset.train
    if scan.effects is not None and effects == 'model':
        scan = linearised(scan, scan.effects)
    return scan, dict(fit=fit_cloud) if isinstance(algorithm, Best) else {}


def sample_cloud(out: Path, cloud: Fitted | FittedCloud, dataset: Dataset, args: argparse.Namespace) -> None:
    """Write the cloud's own volume."""
    geometry, sample = dataset.train.geometry, sampled(cloud)
    if args.slab:
        slabs = (sample(geometry.slab(*part)) for part in geometry.slabs(args.slab))
        write_in_slabs(out, dataset.train, slabs, args)
        return
    began = time.perf_counter()
    volume = sample(geometry)
    found = Reconstruction(volume, [], time.perf_counter() - began, geometry)
    views = len(cloud.geometry)
    write_volume(out, found, f'a cloud fitted to {views}', views, dataset.volume, args)


def write_volume(
    out: Path, found: Reconstruction, of: str, measured: int, truth: np.ndarray | None, args: argparse.Namespace
) -> None:
    """Write a volume, and its page if asked for, and say how it was made and how good it is.

    of         how many views it was made of, in words
    measured   how many of them were measured
    """
    found.save(out, force=True)  # `output` has refused to replace a file without --force
    missed = ''
    if found.residuals:
        missed = f', |A x - b| / |b| = {found.residuals[-1]:.4g} after {len(found.residuals) - 1} iterations'
    print(f'{args.algorithm} of {of} views: {found.seconds:.1f} s{missed}')
    if truth is not None:
        print(volume_quality(found.metrics(truth)))
    print(out)
    if args.report is not None:
        write_page(args.report, found, measured, truth, args)
        print(args.report)


def write_page(
    path: Path, found: Reconstruction, measured: int, truth: np.ndarray | None, args: argparse.Namespace
) -> None:
    """Write the page of a reconstruction from `measured` views."""
    geometry = found.geometry
    numbers = found.metrics(truth) if truth is not None else {}
    data = ReportData(
        title=f'{input_name(args)}, {args.algorithm}',
        metrics=numbers | dict(method=args.algorithm, views=measured, seconds=found.seconds),
        volume=found.volume,
        truth=truth,
        spacing=geometry.dVoxel,
        centre=geometry.offOrigin,
        scanner=geometry,
        error_map=found.error if isinstance(found, Chosen) else None,
        command=command_line(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, report_page(data))


def make_in_slabs(out: Path, scan: Scan, algorithm: Algorithm, args: argparse.Namespace) -> None:
    """Reconstruct a volume slab by slab, and write it."""
    assert isinstance(algorithm, FDK | Sweeps)  # as `check_arguments` has made sure
    with Progress(algorithm.name, algorithm.slab_steps(scan, args.slab)) as bar:

        def report(done: int, _: int, residual: float | None) -> None:
            bar.update(done, residual=residual)

        if isinstance(algorithm, FDK):
            write_in_slabs(out, scan, algorithm.slabs(scan, args.slab, progress=report), args)
        else:
            work = out.with_name(out.name + '.slabs')
            write_in_slabs(out, scan, algorithm.slabs(scan, args.slab, work, progress=report), args)
            discard(work)  # not before the volume is safe


def write_in_slabs(out: Path, scan: Scan, slabs: Iterator[np.ndarray], args: argparse.Namespace) -> None:
    """Write a volume, slab by slab as it is made."""
    began = time.perf_counter()
    out.parent.mkdir(parents=True, exist_ok=True)
    write_slabs(out, scan.geometry, slabs)
    shape = ' x '.join(map(str, scan.geometry.nVoxel))
    print(
        f'{args.algorithm}, {shape} voxels in slabs of {args.slab} slices: {time.perf_counter() - began:.1f} s\n{out}'
    )
