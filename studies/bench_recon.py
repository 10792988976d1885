"""Time reconstruction on voxels against RTK and diffct on the CPU: projector, transpose, FDK, one SART iteration.

    python -m studies.bench_recon
    python -m studies.bench_recon --size 256 --views 100 --json bench_recon.json
    python -m studies.bench_recon --size 128 --tilt 5
    python -m studies.bench_recon --variant cuda_ad_mono

The Shepp-Logan phantom on SIZE^3 voxels, VIEWS views of SIZE x SIZE pixels over a full turn. In every repeat each operation
is run by each package in turn, on the same cores, from arrays in memory to an array in memory; medians are printed, the first
round, which compiles, is not counted. A ratio is a package's time over ours: above 1 it is slower. The deviation is the
relative RMS difference from our result, without the outermost voxels, whose outer halves RTK leaves out. It is not small
where methods differ: diffct projects voxels that are constant (Siddon), ours and RTK's interpolate (Joseph); RTK's SART
backprojects by interpolating the panel, ours by the matched transpose. `exact` is our own projector without Joseph's error, and
its transpose: what accuracy costs in time.

On a GPU (--variant) ours compute there, the other packages still on the CPU.

RTK comes with `pip install '.[reference]'` in a checkout, diffct with `pip install diffct torch`; what is not installed is
left out.
"""

import argparse
import json
import os
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable, write_text
from studies.command import run_study

os.environ.setdefault('OMP_WAIT_POLICY', 'passive')  # idle threads of one package must not slow the next one's


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--size', type=int, default=256, metavar='N', help='voxels and pixels along a side (default: 256)')
    p.add_argument('--views', type=int, default=100, metavar='N', help='(default: 100)')
    p.add_argument('--repeats', type=int, default=5, metavar='N', help='rounds (default: 5)')
    p.add_argument(
        '--tilt',
        type=float,
        default=0.0,
        metavar='DEGREES',
        help="angle of the axis of rotation to the volume's (default: 0)",
    )
    p.add_argument('--json', type=Path, metavar='F', help='write the numbers there')
    p.add_argument(
        '--variant', metavar='V', default='llvm_ad_mono', help='Mitsuba variant of ours (default: llvm_ad_mono)'
    )
    return p.parse_args()


def main() -> None:
    args = arguments()
    if args.json:
        require_writable(args.json.parent, args.json, 'choose another --json')
    if min(args.size, args.views, args.repeats) < 1 or args.size < 8:
        raise InputError('--size must be at least 8, --views and --repeats at least 1')
    if not abs(args.tilt) <= 90:
        raise InputError(f'--tilt must be an angle from -90 to 90 degrees, not {args.tilt:g}')
    use_variant(args.variant)
    from studies.benchmarks.reconstruction import describe, measure

    result = measure(args.size, args.views, args.repeats, args.tilt)
    print('\n'.join(describe(result)))
    if args.json:
        write_text(args.json, json.dumps(result, indent=1) + '\n')


if __name__ == '__main__':
    run_study('bench_recon', main)
