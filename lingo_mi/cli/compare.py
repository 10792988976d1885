"""Show results side by side: the same slices and views, their differences, numbers, settings and times, in one page."""

from pathlib import Path

from lingo_mi.cli.common import Parser, spacing_argument
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import require_writable, write_text
from lingo_mi.storage.folder_lock import writing_file

EPILOG = """\
examples:
  lingo-mi compare out/fast out/lingo
      writes compare.html in the current folder; differences are to the first result
  lingo-mi compare out/fast out/x3d_foot-fdk.nii.gz --truth foot.nii.gz --out fast-fdk.html
      a fit and a volume of reconstruct, with their differences to the true volume"""


def parser() -> Parser:
    p = Parser(description=__doc__, epilog=EPILOG)
    p.add_argument(
        'results',
        nargs='+',
        metavar='RESULT',
        help='a folder that fit wrote, or a volume in any format that --volume reads',
    )
    p.add_argument('--truth', type=Path, metavar='F', help='the true volume, to compare with')
    p.add_argument(
        '--mu-water',
        type=float,
        metavar='MU',
        help='if the truth has Hounsfield units: the attenuation of water, 1/mm, that the results were made with',
    )
    spacing_argument(p, '--truth')
    p.add_argument(
        '--out', type=Path, default=Path('compare.html'), metavar='F.html', help='the page (default: compare.html)'
    )
    p.add_argument('--title', default='', help='title of the page')
    p.add_argument('--force', action='store_true', help='replace an earlier page')
    return p


def main() -> None:
    args = parser().parse_args()
    from lingo_mi.files.volumes import read_volume
    from lingo_mi.results.compare import compare_page, load_result

    if args.out.suffix.lower() not in ('.html', '.htm'):
        raise InputError(f'{args.out}: a comparison is a page; give a name that ends in .html')
    if args.out.exists() and not args.force:
        raise InputError(f'{args.out}: exists already; give --force to replace it, or another --out')
    if args.truth is None and (args.spacing or args.mu_water is not None):
        raise InputError('--spacing and --mu-water go with --truth')
    require_writable(args.out.parent, args.out)
    results = [load_result(path) for path in args.results]
    truth = read_volume(args.truth, args.mu_water, spacing=args.spacing) if args.truth else None
    page = compare_page(results, truth, args.title)
    with writing_file(args.out):
        write_text(args.out, page)
    print(args.out)
