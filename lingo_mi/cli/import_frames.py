"""Turn raw frames into a scan that every command reads: line integrals, their geometry, and a mask of valid pixels."""

from pathlib import Path

from lingo_mi.cli.common import Parser, check_scan_output
from lingo_mi.common.errors import InputError

EPILOG = """\
examples:
  lingo-mi import frames/ --flats flats/ --darks darks/ --geometry scanner.yml --out scan.npy
      folders of images; scanner.yml needs DSO, DSD, dDetector and angles or totalAngle
  lingo-mi import tomo.h5 --geometry scanner.yml --binning 2 --out scan.npy
      NXtomo or DXchange, with its own flats, darks and angles
  lingo-mi import tiffs/ --geometry scan.xtekct --air 0 400 0 60 --out scan.npy
      Nikon, with the air level of every view from a region without object
  lingo-mi import large.nxs --geometry scanner.yml --out scan.zarr
      a few views at a time, for a scan that is larger than memory
  lingo-mi import dicom/ --out scan.npy
      DICOM-CT-PD, which says its geometry; frames of a C-arm need the air level, too
  lingo-mi fit scan.npy"""


def parser() -> Parser:
    p = Parser(description=__doc__, epilog=EPILOG)
    add = p.add_argument
    add(
        'frames',
        help='a folder of .tif, .edf, .png, .jp2, .his, .hnd, .hnc or .xim images, a multi-page .tif, a .edf, DICOM (a file or a '
        "folder), Zeiss' .txrm, .npy [n, v, u], or .h5 / .nxs",
    )
    add(
        '--geometry',
        metavar='F',
        help="geometry of the whole frames: .yml, a scanner's .xtekct (Nikon), .nsipro (NSI), .log (Bruker) or .pca (GE), or "
        "RTK's .xml (default: what the frames' own file says: DICOM, .txrm)",
    )
    add(
        '--out',
        required=True,
        type=Path,
        metavar='F.npy|F.zarr',
        help='the scan; F.yml is written beside it, F.valid.npy if pixels are not valid, and F.poses.npy for many poses. F.zarr '
        'is written a few views at a time, and must be new',
    )
    add('--flats', metavar='F', help='frames without object')
    add('--darks', metavar='F', help='frames without beam')
    add(
        '--air',
        type=int,
        nargs=4,
        metavar=('V0', 'V1', 'U0', 'U1'),
        help='pixels without object in every view, which give its air level',
    )
    add(
        '--air-percentile',
        dest='percentile',
        type=float,
        metavar='P',
        help='in place of --air: a percentile of each view is its air level',
    )
    add(
        '--i0',
        type=float,
        metavar='COUNTS',
        help='in place of --flats: counts of the unattenuated beam above the dark ones',
    )
    add(
        '--exposure',
        metavar='X',
        help='exposure of the views over the exposure of the flats: a number, or a file with one a line',
    )
    add(
        '--saturation',
        type=float,
        metavar='COUNTS',
        help='counts from here on are not valid (default: the largest integer)',
    )
    add('--crop', type=int, nargs=4, metavar=('V0', 'V1', 'U0', 'U1'), help='pixels to keep')
    add('--binning', type=int, default=1, metavar='N', help='N x N pixels become one (default 1)')
    add('--views', metavar='A:B:STEP', help='the views to keep, such as ::4')
    add('--angles', metavar='F', help='a file of angles in degrees, one a line (.txt, .ang)')
    add('--pixel', type=float, metavar='MM', help="size of a raw pixel, for RTK's geometry")
    add(
        '--rings',
        action='store_true',
        help='subtract what single pixels add in all views, such as gains that have changed since the flats',
    )
    add(
        '--outliers', action='store_true', help='leave out pixels that are far brighter than their neighbours (zingers)'
    )
    add('--force', action='store_true', help='overwrite existing files')
    return p


def chosen_views(text: str | None) -> tuple[int, int | None, int] | None:
    """'A:B:STEP' as numbers."""
    if text is None:
        return None
    try:
        parts = [int(part) if part else None for part in text.split(':')]
        first, end, step = (*parts, None, None, None)[:3]
        if not 2 <= len(parts) <= 3 or (step is not None and step < 1):
            raise ValueError
    except ValueError:
        raise InputError(f'--views must be FIRST:END:STEP, such as 0:100:2 or ::4, not {text!r}') from None
    return first or 0, end, step or 1


def main() -> None:
    args = parser().parse_args()
    from lingo_mi.files.geometry_file import named_files
    from lingo_mi.files.scans import write_scan
    from lingo_mi.raw.importing import import_raw, import_to_zarr
    from lingo_mi.raw.nikon import read_numbers
    from lingo_mi.raw.options import Options

    if args.binning < 1:
        raise InputError(f'--binning must be at least 1, not {args.binning}')
    named = named_files(args.geometry) if Path(args.geometry or '').suffix.lower() in ('.yml', '.yaml') else []
    inputs = [args.frames, args.geometry, args.flats, args.darks, args.angles, args.exposure, *named]
    check_scan_output(args.out, inputs, args.force, ('.npy', '.zarr'))
    exposure = 1.0
    if args.exposure is not None:
        try:
            exposure = float(args.exposure)
        except ValueError:
            exposure = read_numbers(args.exposure)
    options = Options(
        flats=args.flats, darks=args.darks, air=args.air, percentile=args.percentile, i0=args.i0, exposure=exposure,
        saturation=args.saturation, crop=args.crop, binning=args.binning, views=chosen_views(args.views), angles=args.angles,
        pixel=args.pixel, rings=args.rings, outliers=args.outliers,
    )  # fmt: skip
    if args.out.suffix == '.zarr':
        args.out.parent.mkdir(parents=True, exist_ok=True)
        imported = import_to_zarr(args.frames, args.geometry, options, args.out)
    else:
        scan, imported = import_raw(args.frames, args.geometry, options)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_scan(args.out, scan, 'npy', imported.history)
    history, (rows, columns) = imported.history, imported.geometry.nDetector
    photons = history.get('photons_from_flats', history['photons_from_views'])
    print(f'{args.out}: {len(imported.geometry)} views of {rows} x {columns} pixels')
    print(f'  {history["bad_pixels"]} bad pixels of the panel, {imported.left_out:.2%} of all pixels left out')
    if 'rings' in history:
        print(f'  rings: {history["rings"]:.3g} rms of line integrals subtracted, the same in all views')
    if 'darks' not in history and 'corrected_before' not in history:
        print('  no dark frames: counts without beam are taken to be 0')
    source = 'flats' if 'photons_from_flats' in history else 'views'
    print(f'  about {photons:.3g} photons a pixel, from the scatter of the {source}')
