"""Find where a scanner's panel really is (an axis off centre, a turn of the panel in its plane, a drift), and the response of
its detector to line integrals."""

import warnings
from pathlib import Path

from lingo_mi.cli.common import Parser, check_scan_output
from lingo_mi.common.runtime import use_variant

EPILOG = """\
examples:
  lingo-mi calibrate scan.npy
      prints what was found; changes nothing
  lingo-mi calibrate scan.npy --drift 3 --out calibrated.npy
      also a drift over the scan; writes the scan with the geometry that was found
  lingo-mi fit calibrated.npy"""


def parser() -> Parser:
    p = Parser(description=__doc__, epilog=EPILOG)
    p.add_argument(
        'scan', help='a scan in any format that --projections of fit reads, views in the order of their time'
    )
    p.add_argument(
        '--drift',
        type=int,
        default=0,
        metavar='N',
        help='degree of a polynomial in time for its shifts (default 0: none)',
    )
    p.add_argument('--air', action='store_true', help='also an air level, smooth in time')
    p.add_argument('--gain', action='store_true', help='also a gain of the views, smooth in time')
    p.add_argument(
        '--curve',
        type=int,
        default=0,
        metavar='K',
        help='also a curve of K coefficients from line integral to measured value, as for beam hardening',
    )
    p.add_argument('--scatter', action='store_true', help='also scattered light, one smooth image for all views')
    p.add_argument(
        '--out', type=Path, metavar='F.npy', help='the scan with the geometry found; F.yml is written beside it'
    )
    p.add_argument('--force', action='store_true', help='overwrite existing files')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p


def main() -> None:
    args = parser().parse_args()
    if args.out is not None:
        check_scan_output(args.out, _inputs(Path(args.scan)), args.force)
    use_variant(args.variant)
    from lingo_mi.api.calibration import calibrate
    from lingo_mi.files.scans import history_of, read_scan, write_scan

    dataset = read_scan(args.scan)
    scan = dataset.train
    if args.out is not None and (dataset.test is not None or dataset.volume is not None):
        warnings.warn(
            f'{args.out}: holds the views to fit alone, not the held-out views or the volume of {args.scan}',
            stacklevel=2,
        )
    calibration = calibrate(
        scan, drift=args.drift, air=args.air, gain=args.gain, curve=args.curve, scatter=args.scatter
    )
    print('\n'.join(calibration.lines()))
    if not calibration.needed:
        print('nothing to correct was found')
    if args.out is not None:
        history = dict(calibrated_from=Path(args.scan).name, calibration=calibration.lines())
        before = history_of(args.scan)
        history |= {} if before is None else dict(before=before)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_scan(args.out, calibration.corrected(scan), 'npy', history)
        print(args.out)


def _inputs(scan: Path) -> list[Path]:
    """The files of a scan that is not a folder."""
    from lingo_mi.files.geometry_file import geometry_file_of, named_files

    if scan.suffix != '.npy':
        return [scan]
    geometry = Path(geometry_file_of(scan))
    return [scan, geometry, *named_files(geometry)]
