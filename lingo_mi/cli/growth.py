"""Measure how cost grows: CPU time and peak memory of every stage, as voxels, pixels, views and Gaussians grow by tens.

    lingo-mi growth
    lingo-mi growth --large --docs docs

Stages are the initial cloud of `fast`, a step, sampling the cloud on voxels, FDK, a pass of SART, the measures of quality, and
the files. One quantity grows at a time, from 64 voxels and 128 pixels a side, 20 views and 10,000 Gaussians. Times are those of
the CPU, user and system, so that other work on the machine does not count. On Linux, and without a GPU.

Takes a few minutes, with --large half an hour. Writes growth.json, growth.md and growth.png to --out.
"""

import argparse
import json
from pathlib import Path

from lingo_mi.cli.common import Parser, docs_arguments, docs_of
from lingo_mi.errors import InputError
from lingo_mi.file_access import require_writable, write_text


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--large', action='store_true', help='one factor of ten more of voxels, pixels and Gaussians')
    p.add_argument('--out', type=Path, default=Path('out/growth'), metavar='D', help='folder (default: out/growth)')
    docs_arguments(p, 'benchmarks/growth.md', 'figures')
    return p.parse_args()


def main() -> None:
    args = arguments()
    if not Path('/proc/self/clear_refs').exists():
        raise InputError('lingo-mi growth asks Linux for the peak of memory, and this is another system')
    document, figures = docs_of(args)
    require_writable(args.out, args.out, 'choose another --out')
    from lingo_mi.progress import Progress
    from lingo_mi.studies.growth.report import draw, exponents
    from lingo_mi.studies.growth.stages import DEPENDS
    from lingo_mi.studies.growth.sweep import sweep
    from lingo_mi.studies.markdown import check_places, insert_into
    from lingo_mi.studies.provenance import write_provenance

    if document:
        check_places(document, ['growth'])
    done = 0
    with Progress('Stages', len(DEPENDS)) as bar:

        def after(stage):
            nonlocal done
            done += 1
            bar.update(done, stage=stage)

        found = sweep(args.large, after)
    args.out.mkdir(parents=True, exist_ok=True)
    text = exponents(found)
    write_text(args.out / 'growth.json', json.dumps(found, indent=1) + '\n')
    write_text(args.out / 'growth.md', text + '\n')
    write_provenance(args.out / 'growth.md')
    draw(found, figures / 'growth.png')
    if document:
        insert_into(document, {'growth': text})
    print(text)
    print(f'{args.out}/: growth.json, growth.md; {figures / "growth.png"}')
