"""Time the integrator, forward and backward, against a kernel written by hand for this job and against Mitsuba's tree.

    lingo-mi bench
    lingo-mi bench --gaussians 50000 --size 512 --extent 3 --json bench.json

It renders a random cloud through mi.render and differentiates it through dr.backward, Python and set-up included. In turn, so
that both see the same machine, it runs limit.cpp of lingo_mi.validation on as many pairs (AVX2, two threads, nothing but the
arithmetic of a pixel in a fixed box). In each turn the best of five tries counts, and medians of all turns are printed. A pair
is a pixel in the bounding box of a Gaussian's footprint. The limit needs g++.

Then it computes the same image once by marching through the tree of `ellipsoids`, hit by hit, and compares both with float64 on
some of the pixels. That takes a minute; --no-bvh leaves it out. Numbers that were not measured are null in the JSON.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.common.runtime import use_variant
from lingo_mi.storage.file_access import require_writable, write_text

MOST_PIXELS = 30_000  # a larger box would leave limit.cpp's image


def parser() -> Parser:
    p = Parser(description=__doc__)
    p.add_argument('--gaussians', type=int, default=50_000)
    p.add_argument('--size', type=int, default=512, help='pixels along a side of the square panel')
    p.add_argument('--pixels', type=float, default=234, help="mean pixels in a Gaussian's box")
    p.add_argument('--extent', type=float, default=3.0, help='cut-off in standard deviations')
    p.add_argument('--repeats', type=int, default=15, help='turns')
    p.add_argument('--no-bvh', dest='bvh', action='store_false', help="leave out Mitsuba's tree")
    p.add_argument('--json', type=Path, help='write the numbers there')
    p.add_argument('--variant', metavar='V', help='Mitsuba variant (default: cuda_ad_mono, else llvm_ad_mono)')
    return p


def check(args: argparse.Namespace) -> None:
    """Raises InputError for numbers out of their ranges."""
    for name, low, high in (
        ('gaussians', 1, 10_000_000),
        ('size', 8, 8192),
        ('pixels', 1, MOST_PIXELS),
        ('extent', 1, 20),
        ('repeats', 1, 10_000),
    ):
        if not low <= getattr(args, name) <= high:
            raise InputError(f'--{name} must be from {low} to {high}, not {getattr(args, name):g}')


def main() -> None:
    args = parser().parse_args()
    check(args)
    variant = use_variant(args.variant)
    from lingo_mi.validation.benchmark import TREE, Bench, Work, describe_times, describe_tree
    from lingo_mi.validation.cuda_model import beside

    if args.json:
        require_writable(args.json.parent, args.json, 'choose another --json')
    bench = Bench(Work(args.gaussians, args.size, args.pixels, args.extent, args.repeats))
    result: dict[str, Any] = {**bench.times(), **dict.fromkeys(TREE)}
    print(describe_times(result, args.repeats))
    if variant.startswith('cuda'):
        for part, name in (('image', 'forward'), ('derivatives', 'backward')):
            print(beside(name, part, result[f'{name}_ms'] / 1e3, args.gaussians, result['pairs']))
    if args.bvh:
        result |= bench.against_tree()
        print(describe_tree(result))
    if args.json:
        write_text(args.json, json.dumps(result, indent=1) + '\n')
