"""Give every reader mutated files, each in a child with a limit of time and memory: a value, or one line that refuses it.

    python -m studies.fuzz --cases 200
    python -m studies.fuzz --total 100000 --markdown fuzz.md
    python -m studies.fuzz --readers nii tiff --cases 5000 --seed 7

A case is its reader, the seed and its number. Those that fail are saved in --out, each in a folder with its files.
The exit code is 1 where one fails.
"""

import argparse
import math
import sys
import time
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import require_writable, write_text
from studies.command import run_study


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--readers', nargs='+', metavar='NAME', help='readers to test (default: all)')
    p.add_argument('--cases', type=int, default=200, metavar='N', help='cases for every reader (default 200)')
    p.add_argument('--total', type=int, metavar='N', help='cases for all readers together, instead')
    p.add_argument('--seed', type=int, default=0)
    p.add_argument('--processes', type=int, default=2, metavar='N', help='children at a time (default 2)')
    p.add_argument('--seconds', type=float, default=10.0, metavar='S', help='seconds that a case may take (default 10)')
    p.add_argument('--memory', type=float, default=1.0, metavar='GIB', help='GiB that a child may take (default 1)')
    p.add_argument('--out', type=Path, default=Path('out/fuzz'), metavar='DIR', help='where cases that fail are saved')
    p.add_argument('--markdown', type=Path, metavar='F', help='write the page there, too')
    return p.parse_args()


def main() -> int:
    args = arguments()
    from lingo_mi.common.progress import Progress
    from lingo_mi.validation.provenance import write_provenance
    from studies.fuzz.page import page
    from studies.fuzz.pool import run, save_case
    from studies.fuzz.readers import NAMES

    names = args.readers or list(NAMES)
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        raise InputError(f'--readers {unknown[0]}: is not one of {", ".join(NAMES)}')
    cases = args.cases if args.total is None else -(-args.total // len(names))
    if not all(0 < x < math.inf for x in (cases, args.processes, args.seconds, args.memory)):
        raise InputError('--cases, --total, --processes, --seconds and --memory must be positive')
    require_writable(args.out, args.out, 'choose another --out')
    if args.markdown:
        require_writable(args.markdown.parent, args.markdown, 'choose another --markdown')
    memory, start = int(args.memory * 2**30), time.monotonic()
    with Progress('Read', cases * len(names)) as bar:
        tallies = run(
            names,
            cases,
            args.seed,
            processes=args.processes,
            seconds=args.seconds,
            memory=memory,
            report=lambda done: bar.update(done),
        )
    text = page(tallies, args.seed, time.monotonic() - start, args.seconds, memory)
    print(text)
    failures = [(name, number, what) for name, t in tallies.items() for number, what in t.failures.items()]
    for name, number, what in failures:
        where = save_case(name, args.seed, number, what, args.out)
        print(f'failed: {name}, case {number}: {what} ({where})', file=sys.stderr)
    if args.markdown:
        write_text(args.markdown, text)
        write_provenance(args.markdown)
    return int(bool(failures))


if __name__ == '__main__':
    run_study('fuzz', main)
