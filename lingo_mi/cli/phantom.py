"""Make a test object and, if asked, a noise-free scan of it."""

import argparse
from pathlib import Path
from typing import Any

from lingo_mi import phantoms
from lingo_mi.cli.common import Parser, check_seed
from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import room
from lingo_mi.geometry.limits import MOST_VIEWS
from lingo_mi.phantoms.x3d_scan import PIXELS
from lingo_mi.storage.file_access import replacing, require_writable

EPILOG = """\
phantoms:
{list}

examples:
  lingo-mi phantom foot --out foot.nii.gz
      the default object on 256^3 voxels of 1 mm
  lingo-mi phantom foot --size 128 --out foot.nii.gz --projections foot.pickle --kind naf
      and its scan in the format of NAF, SAX-NeRF and X3D
  lingo-mi phantom mesh --out flange.ply
      the flange as a mesh, and bolts for its holes (flange_bolts.ply)
  lingo-mi phantom gaussians --out cloud.ply
      the Gaussians themselves, for Mitsuba's `ellipsoids`
  lingo-mi phantom chest --projections chest_scan --kind r2 --views 25
      a scan alone, as a folder for R2-Gaussian

The scan is X3D's: a cone beam, DSD 1500 mm, DSO 1000 mm, 512 x 512 pixels of 1 mm (1.48 mm for the chest),
training views evenly over [0, 180) degrees and as many random ones held out. Values are densities in [0, 1]
and line integrals in density times mm, larger than any scanner measures; --attenuation real scales them to
dense bone, per mm. shepp_logan, gaussians and mesh are projected exactly, foot and chest as trilinear
voxels."""

SUMMARY = {
    'foot': 'right foot and ankle: bones with trabeculae, soft tissue (256 mm)',
    'chest': 'ribs, spine, lungs with vessels, heart (380 mm)',
    'shepp_logan': 'ten ellipsoids, exact (256 mm)',
    'gaussians': '2000 random Gaussians, exact (256 mm)',
    'mesh': 'a tilted metal flange, exact (256 mm)',
}


def listing() -> str:
    """The phantoms, a line each."""
    return '\n'.join(f'  {name:12s} {SUMMARY[name]}' for name in phantoms.names())


def parser() -> Parser:
    p = Parser(description=__doc__, epilog=EPILOG.format(list=listing()))
    p.add_argument('name', nargs='?', metavar='NAME', help='which phantom, see below')
    p.add_argument('--list', action='store_true', help='print the names and exit')
    p.add_argument('--size', type=int, default=256, metavar='N', help='voxels a side, 8 to 512 (default 256)')
    p.add_argument(
        '--seed',
        type=int,
        default=0,
        metavar='S',
        help='seed of texture, vessels, random Gaussians and held-out angles (default 0)',
    )
    p.add_argument(
        '--attenuation',
        choices=phantoms.ATTENUATIONS,
        default='x3d',
        help="x3d: densities in [0, 1], X3D's convention; real: these times 0.0618 per mm, dense bone at 60 keV (default x3d)",
    )
    p.add_argument(
        '--out', type=Path, metavar='F.nii.gz', help='where to write the volume; for mesh and gaussians also F.ply'
    )
    p.add_argument(
        '--projections', type=Path, metavar='PATH', help='where to write a scan: a .pickle file or a new folder'
    )
    p.add_argument(
        '--kind',
        choices=('naf', 'r2', 'exr'),
        default='naf',
        help='format of the scan: naf writes a pickle, r2 and exr a folder (default naf)',
    )
    p.add_argument(
        '--views', type=int, default=50, metavar='N', help='training views, and as many test views (default 50)'
    )
    p.add_argument('--variant', help='Mitsuba variant for foot and chest (default cuda_ad_mono, else llvm_ad_mono)')
    p.add_argument('--force', action='store_true', help='overwrite existing files (never folders)')
    return p


def check(args: argparse.Namespace) -> None:
    """Everything that can be refused before the work begins."""
    if args.name is None:
        raise InputError(f'name a phantom: one of {", ".join(phantoms.names())}')
    phantoms.require_name(args.name)
    if args.out is None and args.projections is None:
        raise InputError('nothing to write: give --out, --projections or both')
    if args.views < 1:
        raise InputError(f'--views must be at least 1, not {args.views}')
    check_seed(args.seed)
    if args.projections:
        check_views(args.views)
    if args.projections and args.kind == 'naf' and args.projections.suffix not in ('.pickle', '.pkl'):
        raise InputError(f'{args.projections}: --kind naf writes a pickle; give a name that ends in .pickle')
    beside = None
    if args.name == 'mesh' and args.out is not None and args.out.suffix == '.ply':
        beside = bolts_beside(args.out)
    for path in filter(None, (args.out, beside, args.projections)):
        if path.is_dir() and path == args.out:
            raise InputError(f'{path}: is a folder; give a file name that ends in .nii.gz')
        if path.exists() and not (args.force and path.is_file()):
            raise InputError(
                f'{path}: exists already; '
                + ('add --force to overwrite it' if path.is_file() else 'remove the folder or give another name')
            )
        if not path.absolute().parent.is_dir():
            raise InputError(f'{path}: the folder {path.parent} does not exist; make it first')
        require_writable(path.parent, path)
    if args.out is not None and not args.out.name.endswith(('.nii', '.nii.gz')):
        if args.out.suffix != '.ply':
            raise InputError(f'{args.out}: volumes are written as NIfTI; give a name that ends in .nii.gz')
        if args.name not in ('gaussians', 'mesh'):
            raise InputError(
                f'{args.out}: only gaussians and mesh can be written as PLY; give a name that ends in .nii.gz'
            )


def check_views(views: int) -> None:
    """Raises InputError for more training and test views than a scan has, or than this process has memory for."""
    if views > MOST_VIEWS:
        raise InputError(f'--views must be at most {MOST_VIEWS}, not {shown(views)}')
    needed = 2 * 2 * views * 4 * PIXELS**2  # as they are made, and again as they are written
    if needed > (has := room()):
        raise InputError(
            f'--views {views}: as many training and as many test views need at least {needed / 2**30:,.1f} GiB of memory, '
            f'but this process may take {has / 2**30:,.1f} GiB; take fewer'
        )


def bolts_beside(path: Path) -> Path:
    """Return the path of the bolts of the flange in `path`."""
    return path.with_stem(path.stem + '_bolts')


def write_ply(path: Path, phantom: phantoms.Phantom) -> None:
    """The phantom's own form: Gaussians, or the flange and its bolts."""
    analytic: Any = phantom.analytic  # of the class of its own module
    scale = 1.0
    if isinstance(analytic, phantoms.Scaled):
        analytic, scale = analytic.analytic, analytic.factor
    if phantom.name == 'gaussians':
        from lingo_mi.files.ply import write_ply

        write_ply(path, analytic.centres, analytic.scales, analytic.quaternions, analytic.density * scale)
        print(f'{path}: {len(analytic)} Gaussians')
        return
    from lingo_mi.phantoms.mesh import bolts

    for name, mesh in ((path, analytic.mesh), (bolts_beside(path), bolts())):
        with replacing(name) as temporary:
            mesh.export(temporary)
        print(f'{name}: {len(mesh.faces)} triangles')


def main() -> None:
    args = parser().parse_args()
    if args.list:
        print(listing())
        return
    check(args)
    phantom = phantoms.make(args.name, args.size, args.seed, args.attenuation)
    if args.out and args.out.suffix == '.ply':
        write_ply(args.out, phantom)
    elif args.out:
        from lingo_mi.files.volumes import write_volume

        write_volume(args.out, phantom.data, phantom.grid, 'normalised' if args.attenuation == 'x3d' else '1/mm')
        print(f'{args.out}: {args.name}, {args.size}^3 voxels of {phantom.spacing[0]:g} mm')
    if args.projections:
        from lingo_mi.common.progress import Progress
        from lingo_mi.files.scans import write_scan
        from lingo_mi.phantoms.x3d_scan import scan

        if phantom.analytic is None:
            from lingo_mi.common.runtime import use_variant

            use_variant(args.variant)
        with Progress('Project', 2 * args.views) as bar:
            dataset = scan(phantom, args.views, args.seed, lambda done, _: bar.update(done))
        write_scan(args.projections, dataset, args.kind)
        print(f'{args.projections}: {args.views} training and {args.views} test views')
