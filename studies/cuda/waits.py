"""Counts of a fit's step: waits for the GPU, copies, loads of kernels and launches.

    python -m studies.cuda.waits PROGRAM out/chest/checkpoint.npz

PROGRAM is a stand-in for the CUDA driver (see `studies.cuda`); on a machine with a GPU, `env`. gdb counts calls of the
driver in runs of 6 and of 7 steps, and prints what the seventh adds.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from lingo_mi.common.errors import InputError
from lingo_mi.validation.markdown import table

CALLS = {
    'waits': ('cuStreamSynchronize', 'cuEventSynchronize', 'cuCtxSynchronize'),
    'copies to, from or within the device': ('cuMemcpy', 'cuMemcpyAsync'),
    'modules loaded': ('cuModuleLoadData', 'cuLinkCreate_v2'),
    'launches': ('cuLaunchKernel',),
}
STEPS = 6  # the first two compile kernels


def calls(program: str, checkpoint: str, steps: int) -> dict[str, int]:
    """Calls of the driver, by function, in a run of some steps of a fit."""
    names = [name for group in CALLS.values() for name in group]
    script = ['set breakpoint pending on', 'set confirm off', 'set pagination off', 'set debuginfod enabled off']
    for number, name in enumerate(names, 1):
        script += [f'break {name}', f'ignore {number} 1000000000']
    script += ['run', 'info breakpoints']
    with tempfile.NamedTemporaryFile('w', suffix='.gdb') as file:
        file.write('\n'.join(script))
        file.flush()
        work = [sys.executable, '-m', 'studies.cuda.work', checkpoint, 'steps', str(steps)]
        command = [program, 'gdb', '-batch', '-x', file.name, '--args', *work]
        try:
            done = subprocess.run(command, capture_output=True, text=True)
        except OSError as error:
            raise InputError(f'{program}: {error.strerror or error}') from None
    if 'exited normally' not in done.stdout:
        raise InputError(
            f'{checkpoint}: the steps did not end normally under gdb: {(done.stderr or done.stdout)[-300:]}'
        )
    return _hits(done.stdout.rpartition('Num ')[2], names)


def _hits(listing: str, names: list[str]) -> dict[str, int]:
    """Calls by name, from gdb's `info breakpoints`, which numbers them as they were set."""
    out = dict.fromkeys(names, 0)
    current = None
    for line in listing.splitlines():
        if number := re.match(r'(\d+)\s', line):
            current = names[int(number[1]) - 1]
        elif (hit := re.search(r'already hit (\d+) time', line)) and current:
            out[current] = int(hit[1])
    return out


def of_a_step(program: str, checkpoint: str) -> dict[str, int]:
    """Return the counts that step STEPS + 1 adds, by kind of call."""
    few, more = (calls(program, checkpoint, n) for n in (STEPS, STEPS + 1))
    return {kind: sum(more[name] - few[name] for name in group) for kind, group in CALLS.items()}


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('program', metavar='PROGRAM')
    p.add_argument('checkpoint', type=Path, help='checkpoint of a fit')
    args = p.parse_args()
    try:
        waits = of_a_step(args.program, str(args.checkpoint))
    except InputError as error:
        sys.exit(f'error: {error}')
    print(table([('a step', lambda row: row[0]), ('calls', lambda row: f'{row[1]}')], waits.items()))  # type: ignore[arg-type]


if __name__ == '__main__':
    main()
