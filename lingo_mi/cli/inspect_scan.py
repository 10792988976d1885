"""Check a scan before work: geometry, air, noise, truncation, order of the views, angles and axis; and name the corrections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import check_new_file

if TYPE_CHECKING:
    from lingo_mi.scan import Scan

EPILOG = """\
examples:
  lingo-mi inspect scan.npy
      prints what was measured and what to correct; draws scan.png in the current folder
  lingo-mi inspect foot_50.pickle --out look.png"""


def parser() -> Parser:
    p = Parser(description=__doc__, epilog=EPILOG)
    p.add_argument('scan', help='a scan in any format that --projections of fit reads')
    p.add_argument('--out', type=Path, metavar='F.png', help='where to draw (default: the name of the scan, .png)')
    p.add_argument('--force', action='store_true', help='replace an earlier picture')
    return p


def main() -> None:
    args = parser().parse_args()
    out = args.out or Path(Path(args.scan).stem + '.png')
    if out.suffix.lower() != '.png':
        raise InputError(f'{out}: the picture is a PNG; give an --out that ends in .png')
    check_new_file(out, args.force)
    from lingo_mi.cli.findings_text import advice, facts
    from lingo_mi.files.scans import read_scan
    from lingo_mi.inspection.measure import measure
    from lingo_mi.inspection.sheet import draw

    scan = read_scan(args.scan).train
    findings = measure(scan)
    measured, wrong = facts(scan, findings), advice(scan, findings)
    if not findings.misplaced and not findings.suspects and findings.intensities is None:
        faults, obstacle = _compare_views(scan)
        measured, wrong = measured + obstacle, wrong + faults
    print('\n'.join(measured))
    print('\nto correct:' if wrong else '\nnothing to correct was found')
    for line in wrong:
        print(f'- {line}')
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(out, scan, findings)
    print(f'\n{out}')


def _compare_views(scan: Scan) -> tuple[list[str], list[str]]:
    """Describe what quick reconstructions show about the order of the views, or why they cannot be made."""
    from lingo_mi.calibration.order import order_faults
    from lingo_mi.common.runtime import ensure_variant

    try:
        ensure_variant()
        return order_faults(scan), []
    except InputError as error:
        return [], [f'order of the views: not measured ({error})']
