"""Reconstruct a CT volume from projections, measured or simulated, or completed from a fitted cloud.

    python scripts/reconstruct.py scenes/x3d_foot.xml --algorithm fdk
    python scripts/reconstruct.py scenes/x3d_foot.xml --algorithm asd-pocs --views 25 -D niter=20 --out foot.nii.gz
    python scripts/reconstruct.py scenes/x3d_foot.xml --algorithm sart --complete out/x3d_foot/result.xml --views 100
    python scripts/reconstruct.py scenes/x3d_foot.xml --algorithm voxelize --complete out/x3d_foot/result.xml
    python scripts/reconstruct.py scenes/x3d_foot.xml --algorithm refined --complete out/x3d_foot/result.xml --views 100
    python scripts/reconstruct.py scenes/x3d_foot.xml --algorithm refined --start out/x3d_foot/result.xml

The input is what fit.py takes. With --complete, the views that the cloud was fitted to are kept, those missing to --views
are rendered from it, and the volume is made of both; the scan must be one on a circle, before an upright panel, with every
pixel. refined, which is the best for few clean views, starts from the cloud's own volume, meets all views first and the
measured ones then; for objects finer than the voxels add -D finer=2. With --start, the volume is made of the views that the
cloud was fitted to, by refined or an iterative algorithm, from the cloud's own volume; any scan will do. Poses that the fit
has corrected are used as it has left them, but not by fdk. Where the true volume is known, PSNR and SSIM are printed, with
its largest density for full scale, then with 1.
Beam hardening and scatter that the scene's tube names are taken out of the projections first, unless -D effects=ignore is
given; with --complete and --start, those that the fit has modelled.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from lingo_mi.cli.common import Parser, check_input, definitions, input_arguments, read_input, writable_file
from lingo_mi.errors import InputError
from lingo_mi.parsing import parse
from lingo_mi.runtime import use_variant
from lingo_mi.scene.shipped import scene_path

ALGORITHMS = ('fdk', 'sart', 'os-sart', 'sirt', 'cgls', 'asd-pocs', 'refined', 'voxelize')


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    input_arguments(p)
    p.add_argument('--algorithm', choices=ALGORITHMS, default='fdk', help='(default: fdk)')
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
        'checkpoint.npz of one by 3dgs or xgaussian',
    )
    p.add_argument(
        '--start', metavar='F', help='result.xml of a fit, whose volume refined or an iterative algorithm starts from'
    )
    p.add_argument('--out', type=Path, metavar='F', help='the volume, NIfTI (default: out/<scene>-<algorithm>.nii.gz)')
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
        help='a parameter of the algorithm, such as niter, lmbda, tviter or filter (see lingo_mi/recon), or of '
        'the scene file; effects=ignore takes projections for line integrals',
    )
    return p.parse_args()


def output(path: Path, force: bool) -> Path:
    """The output file, if it can be written without spoiling one."""
    if not path.name.endswith(('.nii', '.nii.gz')):
        raise InputError(f'{path}: volumes are written as NIfTI; give an --out that ends in .nii or .nii.gz')
    return writable_file(path, force)


def options(function, given: dict[str, str]) -> dict:
    """The -D values of an algorithm's own parameters, with the types of their defaults."""
    from lingo_mi.reconstruction.system import options_of

    known, out = options_of(function), {}
    for name, text in given.items():
        if name not in known:
            raise InputError(
                f'-D {name}: neither a parameter of the scene nor of {function.__name__} '
                f'({", ".join(known) or "it has none"})'
            )
        out[name] = parse(f'-D {name}', text, 0.0 if known[name] is None else known[name])
    return out


def main():
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.completion.clouds import load_cloud
    from lingo_mi.completion.views import as_corrected, complete, fitted_views, without_effects
    from lingo_mi.files.volumes import first_voxel, write_volume
    from lingo_mi.geometry.base import CircularGeometry
    from lingo_mi.progress import Progress
    from lingo_mi.reconstruction.asd_pocs import asd_pocs
    from lingo_mi.reconstruction.cgls import cgls
    from lingo_mi.reconstruction.effects_correction import linearised
    from lingo_mi.reconstruction.fdk import fdk
    from lingo_mi.reconstruction.refined import refined
    from lingo_mi.reconstruction.sart import os_sart, sart, sirt
    from lingo_mi.reconstruction.views import require_signal
    from lingo_mi.results.measure import compared, volume_quality
    from lingo_mi.scene.load import defaults, load_scene
    from lingo_mi.scene.truth import voxelize_cloud

    check_input(args)
    if args.seed is not None and args.seed < 0:
        raise InputError(f'--seed must not be negative, but is {args.seed}')
    from_cloud = args.algorithm in ('refined', 'voxelize')
    if from_cloud and not (args.complete or args.start and args.algorithm == 'refined'):
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
    run = {
        'fdk': fdk,
        'sart': sart,
        'os-sart': os_sart,
        'sirt': sirt,
        'cgls': cgls,
        'asd-pocs': asd_pocs,
        'refined': refined,
        'voxelize': voxelize_cloud,
    }[args.algorithm]
    args.scene = scene_path(args.scene)
    defined, own = definitions(args.define), defaults(args.scene)
    chosen = {k: v for k, v in defined.items() if k not in own}
    effects = chosen.pop('effects', 'model')
    if effects not in ('model', 'ignore') or effects == 'ignore' and (args.complete or args.start):
        raise InputError(
            f"-D effects={effects}: must be 'model' or 'ignore', and with --complete or --start goes by the fit"
        )
    given = options(run, chosen)
    finer = given.get('finer', 1)
    out = output(args.out or Path('out') / f'{Path(args.scene).stem}-{args.algorithm}.nii.gz', args.force)
    scene = load_scene(args.scene, {k: v for k, v in defined.items() if k in own})
    cloud = load_cloud(args.complete or args.start) if args.complete or args.start else None
    if (from_cloud or args.start) and not hasattr(cloud, 'gaussians'):
        raise InputError(
            f'{args.complete or args.start}: opacities and radiances make no volume; '
            + ('leave out --start' if args.start else 'take another --algorithm')
        )
    seed = getattr(cloud, 'seed', None) if args.seed is None else args.seed
    views = len(cloud.geometry) if cloud else args.views
    if not (args.projections or args.volume):  # their geometry is not known before they are read
        check_scan(scene.scanner.geometry, views, args.algorithm, finer)
    dataset = read_input(args, scene, None if cloud else args.views, seed or 0)
    scan = dataset.train
    check_scan(scan.geometry, views, args.algorithm, finer)
    if args.algorithm != 'voxelize':
        require_signal(scan)

    def sample(geometry):
        return voxelize_cloud(cloud.gaussians, geometry, cloud.extent)

    began = time.monotonic()
    if args.algorithm == 'voxelize':
        volume, residuals = sample(scan.geometry), []
    else:
        if args.complete:
            measured = fitted_views(dataset, cloud.geometry)
            on_circle = [isinstance(g, CircularGeometry) for g in (measured.geometry, cloud.corrected)]
            if args.algorithm == 'fdk' and on_circle == [True, False]:
                raise InputError(
                    'filtered backprojection needs a source on a circle, and the fit has corrected the poses: '
                    'take another --algorithm'
                )
            check_scan(measured.geometry, args.views, args.algorithm, finer)
            scan = complete(measured, cloud, args.views)
            if args.algorithm == 'refined':
                given |= dict(completed=scan, sample=sample)
                scan = scan.subset(np.arange(len(measured)))
        elif args.start:
            scan = without_effects(as_corrected(fitted_views(dataset, cloud.geometry), cloud), cloud)
            if args.algorithm == 'refined':
                given = dict(completed_niter=0, sample=sample) | given
            else:
                given['init'] = sample(scan.geometry)
        elif scan.effects is not None and effects == 'model':
            scan = linearised(scan, scan.effects)
        began = time.monotonic()
        volume, residuals = reconstruct(run, scan, given, Progress)
    seconds = time.monotonic() - began
    geometry = scan.geometry
    out.parent.mkdir(parents=True, exist_ok=True)
    write_volume(out, volume, geometry.dVoxel, first_voxel(geometry), 'density per mm')
    of = f'a cloud fitted to {views}' if args.algorithm == 'voxelize' else len(scan)
    print(
        f'{args.algorithm} of {of} views: {seconds:.1f} s'
        + (f', |A x - b| / |b| = {residuals[-1]:.4g} after {len(residuals) - 1} iterations' if residuals else '')
    )
    if dataset.volume is not None:
        print(volume_quality(compared(volume, dataset.volume)))
    print(out)


def check_scan(geometry, views: int | None, algorithm: str, finer: int):
    """Whether so many views of a scan (None: its own) see the volume, and the algorithm has the memory for them, on `finer`
    times as many voxels a side."""
    from lingo_mi.reconstruction.refined import divided
    from lingo_mi.reconstruction.requirements import NEEDS, needed
    from lingo_mi.reconstruction.views import require_rays
    from lingo_mi.scene.checks import check_memory

    require_rays(geometry)
    geometry, views = divided(geometry, finer), views or len(geometry)
    check_memory(geometry, views=views, needed=needed(algorithm, geometry, views) if algorithm in NEEDS else 0)


def reconstruct(run, scan, given, Progress):
    """Volume and residual history of an algorithm, with a progress bar."""
    from lingo_mi.reconstruction.system import options_of

    total = sum(n for name, n in (options_of(run) | given).items() if name.endswith('niter')) or len(scan)
    with Progress(run.__name__, total) as bar:

        def progress(done, _, residual=None):
            bar.update(done, residual=residual)

        result = run(scan, **given, progress=progress)
    return (result, []) if run.__name__ == 'fdk' else (result.volume, result.residuals)
