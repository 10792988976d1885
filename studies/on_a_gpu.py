"""Run the measurements that need an NVIDIA GPU, in nine minutes, the most important first: `python -m studies.on_a_gpu`.

    python -m studies.on_a_gpu
    python -m studies.on_a_gpu --variant llvm_ad_mono --out out/rehearsal
    python -m studies.on_a_gpu --stand-in PROGRAM --out out/rehearsal

Each part is a process of its own with a limit of time. The time that it leaves goes to the next one. Its output and its files
are in the folder --out as soon as it ends. A part that fails, or that runs out of time, does not stop the next one. `summary.md`
has a line for each part. The exit code is 1 if a part failed. Nothing needs a network.

The last parts, which run side by side, fit three scenes with 30,000 steps: the volumes chest_lidc0314 and engine in the folder
that LINGO_MI_DATA names, and the phantom foot. Other phantoms take the place of volumes that are not there.

With another variant, and with --stand-in, the same commands run at small sizes. PROGRAM stands in for the CUDA driver (see
`studies.cuda`). The times then mean nothing, but they show before a GPU is at hand that every command works.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lingo_mi.cli.common import Parser
from lingo_mi.common.errors import InputError
from lingo_mi.storage.file_access import write_text
from lingo_mi.validation.markdown import Column, table
from studies.command import run_study

VARIANT = 'cuda_ad_mono'
TOTAL = 510  # seconds for all parts
REHEARSAL = 900  # seconds for each part of a rehearsal
TESTS = (  # tests repaired since they last ran on a GPU, then files of newer tests and of the operator's
    'tests/cli/test_bad_input.py::test_without_llvm',
    'tests/cli/test_cli.py::test_resume_after_kill',
    'tests/cli/test_crashes.py::test_a_killed_fit_goes_on_to_the_same_numbers',
    'tests/cli/test_reconstruct_input.py::test_too_many_views_and_too_little_memory',
    'tests/cli/test_reconstruct_with_a_fit.py::test_two_stage',
    'tests/cli/test_reconstruct_with_a_fit.py::test_start',
    'tests/cli/test_reconstruct_with_a_fit.py::test_refined',
    'tests/common/test_runtime.py',
    'tests/validation/test_tables.py::test_two_stages',
    'tests/common/test_memory.py',
    'tests/fitting/test_fit.py',
    'tests/functional/test_functional.py',
    'tests/functional/test_projector.py',
    'tests/reconstruction/test_iterative.py',
)
VOLUMES, PHANTOMS = ('chest_lidc0314', 'engine'), ('foot', 'chest', 'shepp_logan')
SMALL_SCENE = '-D voxels=16 -D pixels=24 -D pixel_size=20 -D voxel_size=16 -D views=4 -D test_views=2'


@dataclass(frozen=True)
class Part:
    """One command.

    Parameters
    ----------
    name : str
        The name of its output file.
    seconds : float
        Its limit, if the parts before it leave no time.
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


def scenes() -> list[str]:
    """The three scenes of the long fits: volumes that are there, then phantoms."""
    folder = os.environ.get('LINGO_MI_DATA')
    there = [name for name in VOLUMES if folder and Path(folder, f'{name}.nii.gz').is_file()]
    return [*there, *PHANTOMS][:3]


def all_parts(out: Path, variant: str = VARIANT) -> list[list[Part]]:
    """All parts, in their order. The parts of an inner list run side by side."""

    def part(name: str, seconds: float, command: str, more: str = '', small: str = '') -> Part:
        def words(text: str) -> tuple[str, ...]:
            return tuple(word.format(out=out, variant=variant) for word in text.split())

        return Part(name, seconds, words(f'{command} {more}'), words(f'{command} {small}'))

    def operator(name: str, sizes: str) -> Part:
        command = '-m studies.benchmarks.operator --on-device --variant {variant} --out {out}/' + name
        return part(name, 20, command, sizes, '--size 12 --pixels 16 --views 3 --repeats 1')

    def long_fits(name: str) -> Part:
        return part(
            f'30000_steps_{name}',
            185,
            '-m studies.tables views --variant {variant} --methods r2 lingo --objects '
            f'{name} --out {{out}}/tables_{name} --record {{out}}/cells_{name}.json',
            '--scale paper --views 25 --iterations 30000',
            '--views 2 --iterations 2',
        )

    alone = [
        part(
            'tests',
            80,
            f'-m pytest -v --all -p no:cacheprovider --continue-on-collection-errors {" ".join(TESTS)}',
            '-n 10 --dist=load --maxschedchunk=1',
            '-k test_memory',
        ),
        part(
            'hard_cases',
            80,
            '-m studies.hard_cases --variant {variant} --json {out}/hard_cases.json',
            small='--steps 2 --without million 1000 thousand giants fit',
        ),
        part(
            'fit',
            30,
            '-m lingo_mi fit x3d_foot --variant {variant} --force --out {out}/foot',
            small=f'--iterations 4 {SMALL_SCENE}',
        ),
        part(
            'best',
            50,
            '-m lingo_mi reconstruct x3d_foot --algorithm best --variant {variant} --force --out {out}/best.nii.gz',
            '--views 25',
            f'--views 4 {SMALL_SCENE}',
        ),
        part(
            'bench',
            25,
            '-m lingo_mi bench --no-bvh --variant {variant} --json {out}/bench.json',
            small='--gaussians 100 --size 16 --pixels 20 --repeats 1',
        ),
        part(
            'bench_step', 20, '-m studies.bench_step {out}/foot/checkpoint.npz --variant {variant}', small='--repeats 1'
        ),
        operator('operator', '--repeats 20'),
        operator('operator_256', '--size 256 --pixels 512 --views 100 --repeats 10'),
    ]
    return [*([part] for part in alone), [long_fits(name) for name in scenes()]]


def start(part: Part, out: Path, variant: str, stand_in: str | None, small: bool) -> subprocess.Popen:
    """Start a part, in a group of processes of its own; its output is `NAME.txt` in `out`."""
    command = [*([stand_in] if stand_in else []), sys.executable, *(part.small if small else part.command)]
    environment = os.environ | {'LINGO_MI_TEST_VARIANT': variant, 'PYTHONUNBUFFERED': '1'}
    if stand_in:
        environment['LINGO_MI_CUDA_STAND_IN'] = stand_in
    with open(out / f'{part.name}.txt', 'w', encoding='utf-8') as file:
        return subprocess.Popen(command, stdout=file, stderr=file, env=environment, start_new_session=True)


def run_parts(side_by_side: Sequence[Part], limit: float, *how) -> Iterator[Outcome]:
    """Run parts side by side, for so many seconds at most; yields each when it ends. how: arguments of `start`."""
    begun = time.perf_counter()
    processes = {part.name: start(part, *how) for part in side_by_side}
    running = dict(processes)
    try:
        while running:
            time.sleep(0.05)
            seconds = time.perf_counter() - begun
            for name, process in list(running.items()):
                code = process.poll()
                if code is None and seconds < limit:
                    continue
                result = 'out of time' if code is None else f'failed (exit code {code})' if code else 'done'
                del running[name]
                end(process)
                yield Outcome(name, seconds, result)
    finally:
        for process in processes.values():
            end(process)


def end(process: subprocess.Popen) -> None:
    """Kill a process and all that it has started, so that they do not slow the next part."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def arguments() -> argparse.Namespace:
    p = Parser(description=__doc__)
    p.add_argument('--out', type=Path, default=Path('out/on_a_gpu'), metavar='DIR', help='(default: out/on_a_gpu)')
    p.add_argument('--variant', default=VARIANT, metavar='V', help=f'rehearse with this one (default: {VARIANT})')
    p.add_argument('--stand-in', metavar='PROGRAM', help='rehearse under a stand-in for the CUDA driver')
    p.add_argument('--parts', nargs='+', metavar='NAME', help='parts to run (default: all)')
    args = p.parse_args()
    if args.stand_in and shutil.which(args.stand_in) is None:
        raise InputError(f'--stand-in {args.stand_in}: is not a program that can be run')
    names = [part.name for parts in all_parts(args.out) for part in parts]
    for name in args.parts or ():
        if name not in names:
            raise InputError(f'--parts {name}: there is no such part; the parts are {", ".join(names)}')
    return args


def main() -> int:
    begun, args = time.perf_counter(), arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    small = args.stand_in is not None or args.variant != VARIANT
    head = f'{args.variant}{", small sizes" if small else ""}. Scenes of the long fits: {", ".join(scenes())}.'
    if missing := [name for name in VOLUMES if name not in scenes()]:
        head += f' LINGO_MI_DATA does not name a folder with {" and ".join(missing)}.'
    print(head, flush=True)
    columns: list[Column] = [
        ('part', lambda x: x.name),
        ('s', lambda x: f'{x.seconds:.0f}'),
        ('result', lambda x: x.result),
    ]
    chosen = [
        [part for part in parts if not args.parts or part.name in args.parts]
        for parts in all_parts(args.out, args.variant)
    ]
    outcomes: list[Outcome] = []
    for i, side_by_side in enumerate(chosen):
        later = sum(max((part.seconds for part in parts), default=0) for parts in chosen[i + 1 :])
        limit = REHEARSAL if small else TOTAL - later - (time.perf_counter() - begun)
        for outcome in run_parts(side_by_side, limit, args.out, args.variant, args.stand_in, small):
            outcomes.append(outcome)
            print(f'{outcome.name}: {outcome.result}, {outcome.seconds:.0f} s', flush=True)
            write_text(args.out / 'summary.md', f'{head}\n\n{table(columns, outcomes)}\n')
    return int(any(outcome.result != 'done' for outcome in outcomes))


if __name__ == '__main__':
    run_study('on_a_gpu', main)
