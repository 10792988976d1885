"""Check the CUDA backend without a GPU: the tests on cuda_ad_mono under a stand-in for the driver, then NVIDIA's assembler.

    python -m studies.cuda_check --stand-in PROGRAM --share --sm 80
    python -m studies.cuda_check --stand-in PROGRAM --noise --out out/cuda --markdown cuda.md

PROGRAM COMMAND ... runs a command with a CUDA driver that executes Dr.Jit's PTX on the CPU (see studies.cuda). Needs a
checkout, for its tests, and `pip install nvidia-cuda-nvcc-cu12` for ptxas. The exit code is 1 where a test fails, or a kernel
does not assemble or spills registers, other than Dr.Jit's own matrix products. With --out, a run that was stopped goes on with
the test file where it was.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import require_writable, write_text
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--stand-in', required=True, metavar='PROGRAM', help='runs a command with a stand-in for the driver')
    p.add_argument(
        '--tests', type=Path, default=Path('tests'), metavar='FOLDER', help='tests of the checkout (default: tests)'
    )
    p.add_argument(
        '--share', action='store_true', help='few tests of every part that computes on the device: some minutes'
    )
    p.add_argument('--sm', type=int, nargs='+', default=[75, 80, 90], help='compute capabilities times ten')
    p.add_argument(
        '--noise', action='store_true', help='run the first --sm with the errors that NVIDIA allows, and checks'
    )
    p.add_argument('--out', type=Path, metavar='DIR', help='keep what has passed there, and go on from it')
    p.add_argument('--markdown', type=Path, metavar='F', help='write the page there, too')
    args = p.parse_args()
    if shutil.which(args.stand_in) is None:
        raise InputError(f'--stand-in {args.stand_in}: is not a program that can be run')
    if not args.tests.is_dir():
        raise InputError(f'--tests {args.tests}: there is no such folder; run this in a checkout')
    return args


def main() -> int:
    args = arguments()
    if args.markdown:
        require_writable(args.markdown.parent, args.markdown, 'choose another --markdown')
    from lingo_mi.validation.provenance import write_provenance
    from studies.cell_files import CellFiles
    from studies.cuda.assemble import find_ptxas
    from studies.cuda.page import page
    from studies.cuda.suite import SHARE, all_files, run_tests

    find_ptxas()
    stand_in, outcomes, kernels = Path(shutil.which(args.stand_in) or '').resolve(), {}, []
    names = SHARE if args.share else all_files(args.tests)
    with tempfile.TemporaryDirectory() as folder:
        cells = CellFiles(args.out or Path(folder), 'outcome', 'kernels', 'code')
        for i, sm in enumerate(args.sm):
            noise = args.noise and i == 0
            title = f'sm_{sm}, noise, checked' if noise else f'sm_{sm}'
            outcomes[title], compiled = run_tests(
                stand_in, args.tests, names, sm=sm, noise=noise, cells=cells, report=show
            )
            kernels += compiled
    text = page(outcomes, kernels)
    print(text)
    if args.markdown:
        write_text(args.markdown, text)
        write_provenance(args.markdown)
    failed = [name for outcome in outcomes.values() for name in outcome.failed]
    for name in failed:
        print(f'failed: {name}', file=sys.stderr)
    return int(bool(failed) or any(kernel.fails for kernel in kernels))


def show(line: str) -> None:
    print(line, flush=True)


if __name__ == '__main__':
    run_study('cuda_check', main)
