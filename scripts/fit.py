#!/usr/bin/env python3
"""Fit a cloud of 3D Gaussians to a CT scan, and make a volume and new views of it.

    python scripts/fit.py scenes/x3d_foot.xml
    python scripts/fit.py scenes/x3d_foot.xml --method lingo --views 25 --iterations 5000
    python scripts/fit.py scenes/chest.xml --volume my_ct.nii.gz --views 25
    python scripts/fit.py scenes/x3d_foot.xml --projections foot_50.pickle

The scene says what is scanned and by which scanner. Projections are rendered from its object, or read from a file of
measured ones; a cloud is initialised from them, fitted, and written to the output folder with a report (report.html), a
volume in mm (volume.nii.gz), the Gaussians (gaussians.ply), a scene of them (result.xml), held-out views and
metrics.json.
"""
import argparse
import shlex
import sys
from pathlib import Path

from lingo_mi.cli import Parser, between_steps, definitions, guard, writable_folder
from lingo_mi.errors import InputError
from lingo_mi.fit.settings import METHODS
from lingo_mi.runtime import use_variant


def arguments():
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('scene', help='a Mitsuba scene with a ct_scanner, such as scenes/x3d_foot.xml')
    p.add_argument('--method', choices=METHODS, default='fast',
                   help='recipe: fast (default), or the published lingo and r2')
    p.add_argument('--views', type=int, default=0, metavar='N', help='fit N evenly spaced views (default: all)')
    p.add_argument('--iterations', type=int, metavar='N', help="Adam steps (default: the recipe's)")
    p.add_argument('--init', choices=('lingo', 'r2'), help='initial cloud: Otsu masks (lingo) or an FDK volume (r2)')
    p.add_argument('--projections', metavar='F', help='measured projections: X3D/NAF pickle, R2 folder, HTC .npz, '
                   '.npy with a geometry .yml beside it, or a folder of EXR images')
    p.add_argument('--volume', metavar='F', help="a CT volume to scan with the scene's scanner: NIfTI, NRRD, MHA, "
                   'NPY/NPZ, raw, a TIFF stack or a DICOM folder')
    p.add_argument('--shape', type=int, nargs=3, metavar='N', help='voxels x y z of a raw --volume')
    p.add_argument('--dtype', help='type of a raw --volume, such as uint8')
    p.add_argument('--mu-water', type=float, metavar='MU', help='a --volume in HU becomes MU (1 + HU / 1000) per mm '
                   '(default: HU are mapped to densities in [0, 1])')
    p.add_argument('--out', type=Path, metavar='D', help='output folder (default: out/<scene>)')
    p.add_argument('--resume', action='store_true', help='go on from the checkpoint in the output folder')
    p.add_argument('--force', action='store_true', help='replace an earlier result')
    p.add_argument('--seed', type=int, default=0, metavar='N', help='of every random choice (default: 0)')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument('-D', dest='define', action='append', default=[], metavar='NAME=VALUE',
                   help="any setting of the fit (see lingo_mi.fit.settings), or a parameter of the scene file")
    return p.parse_args()


def main():
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.files.scans import read_scan
    from lingo_mi.files.volumes import read_volume
    from lingo_mi.fit.initial import initial_cloud
    from lingo_mi.fit.loop import run
    from lingo_mi.progress import Progress
    from lingo_mi.results import CHECKPOINT, METRICS, quick_measure, summary, write_results
    from lingo_mi.scanning import check_memory, choose_views, defaults, load_scene, take_scan

    if args.views < 0:
        raise InputError(f'--views must be at least 1, not {args.views}')
    if args.seed < 0:
        raise InputError(f'--seed must not be negative, but is {args.seed}')
    if not args.volume and (args.shape or args.dtype or args.mu_water is not None):
        raise InputError('--shape, --dtype and --mu-water go with --volume')
    if args.projections and args.volume:
        raise InputError('--projections and --volume exclude each other: measured views need no volume to scan')
    defined = definitions(args.define)
    own = defaults(args.scene)  # a name of the scene goes before a setting's
    given = {k: v for k, v in defined.items() if k not in own}
    given |= {k: v for k, v in (('iterations', args.iterations), ('init', args.init)) if v is not None}
    unknown = [k for k in given if not hasattr(METHODS[args.method], k)]
    if unknown:
        names = ', '.join(sorted(own)) or 'it has none'
        raise InputError(f'-D {unknown[0]}: neither a parameter of {args.scene} ({names}) nor a setting of the fit '
                         '(see lingo_mi/fit/settings.py)')
    settings = METHODS[args.method].changed(**given)
    folder = writable_folder(args.out or Path('out') / Path(args.scene).stem, args.force, args.resume, METRICS)

    scene = load_scene(args.scene, {k: v for k, v in defined.items() if k in own})
    if args.projections:
        scan = choose_views(read_scan(args.projections), args.views)
        check_memory(scan.train.geometry)
    else:
        volume = read_volume(args.volume, args.mu_water, args.shape, args.dtype) if args.volume else None
        scan = take_scan(scene, args.views, volume, args.seed)
    cloud = None if args.resume else initial_cloud(scan.train, settings, args.seed)
    with Progress('Fit', settings.iterations) as bar, between_steps() as check:
        def progress(iteration, **fields):
            bar.update(iteration, **fields)
            check()
        try:
            fit = run(scan.train, settings, cloud, args.seed, quick_measure(scan), progress, folder / CHECKPOINT,
                      args.resume)
        except KeyboardInterrupt:
            again = [a for a in sys.argv if a not in ('--resume', '--force')] + ['--resume']
            raise KeyboardInterrupt(f'go on with  python {shlex.join(again)}') from None
    result = write_results(folder, fit, scan, title=args.volume or args.projections or scene.name, method=args.method,
                           seed=args.seed, command='python ' + shlex.join(sys.argv))
    print(summary(result))
    print(f'{folder}/: report.html, volume.nii.gz, gaussians.ply, result.xml, metrics.json')


if __name__ == '__main__':
    guard(main)
