"""Run the measurements that need an NVIDIA GPU, in nine minutes, the most important first: `python -m studies.on_a_gpu`.

    python -m studies.on_a_gpu
    python -m studies.on_a_gpu --stand-in PROGRAM --out out/rehearsal

Each part is a process of its own with a limit of time. Its output and its files are in the folder --out as soon as it ends. A
part that fails, or that runs out of time, does not stop the next one. `summary.md` has a line for each part. The exit code is 1
if a part failed. Nothing needs a network.

With --stand-in, the same commands run at small sizes under a program that stands in for the CUDA driver (see `studies.cuda`).
Their times mean nothing, but they show before a GPU is at hand that every command works.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import write_text
from lingo_mi.validation.markdown import Column, table
from studies.command import run_study

VARIANT = 'cuda_ad_mono'
REHEARSAL = 900  # seconds for each part under the stand-in
TESTS = (  # tests repaired since they last ran on a GPU, and the operator's
    'tests/common/test_memory.py',
    'tests/fitting/test_fit.py',
    'tests/functional/test_functional.py',
    'tests/functional/test_projector.py',
    'tests/reconstruction/test_iterative.py',
)
SMALL_SCENE = '-D voxels=16 -D pixels=24 -D pixel_size=20 -D voxel_size=16 -D views=4 -D test_views=2'


@dataclass(frozen=True)
class Part:
    """One command.

    Parameters
    ----------
    name : str
        The name of its output file.
    seconds : float
        Its limit.
    command, small : tuple of str
        Arguments of Python, at full size and for a rehearsal.
    """

    name: str
    seconds: float
    command: tuple[str, ...]
    small: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a part: its name, seconds, and 'done', 'failed (exit code 2)' or 'out of time'."""

    name: str
    seconds: float
    result: str


def parts(out: Path) -> list[Part]:
    """All parts, in their order."""

    def part(name: str, seconds: float, command: str, more: str = '', small: str = '') -> Part:
        command = command.format(out=out, variant=VARIANT)
        return Part(name, seconds, (*command.split(), *more.split()), (*command.split(), *small.split()))

    return [
        part('tests', 90, '-m pytest -q --all -p no:cacheprovider', '-n 4 ' + ' '.join(TESTS), TESTS[0]),
        part(
            'hard_cases',
            60,
            '-m studies.hard_cases --variant {variant} --json {out}/hard_cases.json',
            small='--steps 2 --without million 3000 thousand giants fit',
        ),
        part(
            'fit',
            40,
            '-m lingo_mi fit x3d_foot --variant {variant} --force --out {out}/foot',
            small=f'--iterations 4 {SMALL_SCENE}',
        ),
        part(
            'best',
            60,
            '-m lingo_mi reconstruct x3d_foot --algorithm best --variant {variant} --force --out {out}/best.nii.gz',
            '--views 25',
            f'--views 4 {SMALL_SCENE}',
        ),
        part(
            'bench',
            60,
            '-m lingo_mi bench --variant {variant} --json {out}/bench.json',
            small='--gaussians 100 --size 16 --pixels 20 --repeats 1 --no-bvh',
        ),
        part(
            'bench_step', 30, '-m studies.bench_step {out}/foot/checkpoint.npz --variant {variant}', small='--repeats 1'
        ),
        part(
            'bench_recon',
            40,
            '-m studies.bench_recon --variant {variant} --json {out}/bench_recon.json',
            small='--size 8 --views 3 --repeats 1',
        ),
        part(
            'paper',
            180,
            '-m studies.tables views --variant {variant} --methods r2 lingo --out {out}/tables --record {out}/cells.json',
            '--scale paper --objects chest_lidc0314 engine foot --views 25 --iterations 30000',
            '--objects foot --views 2 --iterations 2',
        ),
    ]


def run_part(part: Part, out: Path, stand_in: str | None) -> Outcome:
    """Run one part; its output is `NAME.txt` in `out`."""
    command = [*([stand_in] if stand_in else []), sys.executable, *(part.small if stand_in else part.command)]
    environment = os.environ | {'LINGO_MI_TEST_VARIANT': VARIANT}
    begun = time.perf_counter()
    with open(out / f'{part.name}.txt', 'w', encoding='utf-8') as file:
        try:
            code = subprocess.run(
                command,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                timeout=REHEARSAL if stand_in else part.seconds,
            ).returncode
            result = 'done' if code == 0 else f'failed (exit code {code})'
        except subprocess.TimeoutExpired:
            result = 'out of time'
    return Outcome(part.name, time.perf_counter() - begun, result)


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--out', type=Path, default=Path('out/on_a_gpu'), metavar='DIR', help='(default: out/on_a_gpu)')
    p.add_argument('--stand-in', metavar='PROGRAM', help='rehearse under a stand-in for the CUDA driver')
    p.add_argument('--parts', nargs='+', metavar='NAME', help='parts to run (default: all)')
    args = p.parse_args()
    if args.stand_in and shutil.which(args.stand_in) is None:
        raise InputError(f'--stand-in {args.stand_in}: is not a program that can be run')
    names = [part.name for part in parts(args.out)]
    for name in args.parts or ():
        if name not in names:
            raise InputError(f'--parts {name}: there is no such part; the parts are {", ".join(names)}')
    return args


def main() -> int:
    args = arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    columns: list[Column] = [
        ('part', lambda x: x.name),
        ('s', lambda x: f'{x.seconds:.0f}'),
        ('result', lambda x: x.result),
    ]
    outcomes: list[Outcome] = []
    for part in parts(args.out):
        if args.parts and part.name not in args.parts:
            continue
        outcomes.append(run_part(part, args.out, args.stand_in))
        print(f'{part.name}: {outcomes[-1].result}, {outcomes[-1].seconds:.0f} s', flush=True)
        write_text(args.out / 'summary.md', table(columns, outcomes) + '\n')
    return int(any(outcome.result != 'done' for outcome in outcomes))


if __name__ == '__main__':
    run_study('on_a_gpu', main)
