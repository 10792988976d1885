"""Time a step of a fit, and each of its parts: the integrator, SSIM, total variation, Adam, densification.

    lingo-mi fit x3d_foot
    python -m studies.bench_step out/x3d_foot/checkpoint.npz

Steps from the end of the fit, on views with random pixels. The parts of the loss are switched off one by one: what a step then
saves is their time. All run in turns, so that all see the same machine; medians of all turns. Densification counts with its share
of a step.
"""

import argparse
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('checkpoint', type=Path, help='checkpoint.npz of a fit of a cloud')
    p.add_argument('--repeats', type=int, default=31, metavar='N', help='turns (default: 31)')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    args = p.parse_args()
    if not 1 <= args.repeats <= 10_000:
        raise InputError(f'--repeats must be from 1 to 10000, not {args.repeats}')
    return args


def main() -> None:
    args = arguments()
    use_variant(args.variant)
    from lingo_mi.fitting.fit import load_fit
    from lingo_mi.fitting.methods.densities import DensityMethod
    from studies.benchmarks.step import described, measured

    fit = load_fit(args.checkpoint)
    if not isinstance(fit.method, DensityMethod):
        raise InputError(f'{args.checkpoint}: is a neural field or composites opacities; its step has other parts')
    print(described(measured(fit, args.repeats)))


if __name__ == '__main__':
    run_study('bench_step', main)
