"""Measure how cost grows: CPU time and peak memory of every stage, as voxels, pixels, views and Gaussians grow by tens.

    python -m studies.growth
    python -m studies.growth --large --docs docs

Stages are the initial cloud of `fast`, a step, sampling the cloud on voxels, FDK, a pass of SART, the measures of quality, and
the files. One quantity grows at a time, from 64 voxels and 128 pixels a side, 20 views and 10,000 Gaussians. Times are CPU
times, user and system, so that other work on the machine does not count. On Linux, and without a GPU.

Takes a few minutes, with --large half an hour. Writes growth.json, growth.md and growth.png to --out. Every stage is stored
when it is done; the same command goes on with what is missing, and measures again what another commit or machine has given.
"""

import argparse
import json
from pathlib import Path

from lingo_mi.cli.common import Parser, docs_arguments, docs_of
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import reading, require_writable, write_text
from lingo_mi.storage.folder_lock import locked
from lingo_mi.validation.provenance import commit, machine, write_provenance
from studies.command import run_study

KEYS = 'stage', 'axis', 'number', 'seconds', 'peak', 'commit', 'machine'


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--large', action='store_true', help='one factor of ten more of voxels, pixels and Gaussians')
    p.add_argument('--out', type=Path, default=Path('out/growth'), metavar='D', help='folder (default: out/growth)')
    docs_arguments(p, 'benchmarks/growth.md', 'figures')
    return p.parse_args()


def read(path: Path) -> list[dict]:
    """Measurements of this commit on this machine that an earlier run has stored.

    Raises
    ------
    InputError
        For another file.
    """
    if not path.exists():
        return []
    with reading(path):
        text = path.read_text(encoding='utf-8', errors='replace')
    try:
        rows = [{key: row[key] for key in KEYS} for row in json.loads(text)]
    except (ValueError, TypeError, KeyError):
        raise InputError(f'{path}: holds no measurements of this command; remove it, or choose another --out') from None
    here = commit(), machine()
    return [row for row in rows if (row['commit'], row['machine']) == here]


def main() -> None:
    args = arguments()
    if not Path('/proc/self/clear_refs').exists():
        raise InputError('python -m studies.growth asks Linux for the peak of memory, and this is another system')
    document, figures = docs_of(args)
    require_writable(args.out, args.out, 'choose another --out')
    from lingo_mi.common.progress import Progress
    from lingo_mi.validation.markdown import check_places, insert_into
    from studies.growth.report import draw, exponents
    from studies.growth.stages import DEPENDS
    from studies.growth.sweep import sweep

    if document:
        check_places(document, ['growth'])
    args.out.mkdir(parents=True, exist_ok=True)
    stored, provenance = args.out / 'growth.json', dict(commit=commit(), machine=machine())
    with locked(args.out), Progress('Stages', len(DEPENDS)) as bar:

        def after(rows, others):
            write_text(stored, json.dumps([row | provenance for row in rows + others], indent=1) + '\n')
            bar.update(len({row['stage'] for row in rows}), last=rows[-1]['stage'])

        rows = sweep(args.large, read(stored), after)
    text = exponents(rows)
    write_text(args.out / 'growth.md', text + '\n')
    write_provenance(args.out / 'growth.md')
    draw(rows, figures / 'growth.png')
    if document:
        insert_into(document, {'growth': text})
    print(text)
    print(f'{args.out}/: growth.json, growth.md; {figures / "growth.png"}')


if __name__ == '__main__':
    run_study('growth', main)
