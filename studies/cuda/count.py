"""Instructions and memory sectors of an image, of its derivatives and of a step of a fit, counted without a GPU.

    lingo-mi fit x3d_foot --out out/foot
    lingo-mi fit chest --views 25 --iterations 400 --out out/chest
    python -m studies.cuda.count PROGRAM out/foot/checkpoint.npz out/chest/checkpoint.npz --json counts.json

PROGRAM is a stand-in for the CUDA driver (see `studies.cuda`), which counts what warps do. Instructions are PTX's,
without moves, since the assembler removes most of them. A sector is 32 bytes, the least that memory moves.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from lingo_mi.storage.file_access import write_text

KINDS = 'fp32', 'fp64', 'int', 'mufu', 'load', 'store', 'atomic', 'branch', 'sync', 'other'
SECTORS = {'l': 'loads', 's': 'stores', 'a': 'atomics'}


def profiled(stand_in: str, *arguments: str) -> tuple[str, dict]:
    """Return the output of `work`, and the counts of all kernels that it launches, by name.

    A kernel's counts: launches; `warp`: instructions of warps by kind; `lanes`: their lanes at work, summed; sectors by kind.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [stand_in, sys.executable, '-m', 'studies.cuda.work', *arguments]
        environment = os.environ | {'CUDA_ON_CPU_PROFILE': folder}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        kernels = {}
        for file in Path(folder).glob('profile.*.json'):
            kernels |= {name: _counts(k) for name, k in json.loads(file.read_text()).items()}
    return done.stdout, kernels


def _counts(kernel):
    warp = {kind: sum(b.get(kind, 0) * b['warps'] for b in kernel['blocks']) for kind in KINDS}
    out = dict(
        launches=kernel['launches'],
        warp=warp,
        lanes=sum(sum(b.get(kind, 0) for kind in KINDS) * b['lanes'] for b in kernel['blocks']),
    )
    for kind, name in SECTORS.items():
        out[name] = sum(x['sectors'] for x in kernel['accesses'] if x['kind'] == kind)
    return out


def difference(more: dict, less: dict) -> dict:
    """The counts of what `more` does beyond `less`, by kernel."""
    out = {}
    for name, counts in more.items():
        other = less.get(name, dict(launches=0, warp=dict.fromkeys(KINDS, 0), lanes=0, loads=0, stores=0, atomics=0))
        if counts['launches'] > other['launches']:
            out[name] = {k: v - other[k] for k, v in counts.items() if k != 'warp'}
            out[name]['warp'] = {kind: counts['warp'][kind] - other['warp'][kind] for kind in KINDS}
    return out


def counted(stand_in: str, cloud: str) -> dict:
    """Sizes, and the kernels of an image and of its derivatives. A fit's checkpoint also has the kernels of a step."""
    sizes, _ = profiled(stand_in, cloud, 'sizes')
    image, both = (profiled(stand_in, cloud, part)[1] for part in ('image', 'derivatives'))
    out = json.loads(sizes) | dict(image=list(image.values()), derivatives=list(difference(both, image).values()))
    if cloud != 'giants':
        few, more = (profiled(stand_in, cloud, 'steps', str(n))[1] for n in (1, 2))
        out['step'] = list(difference(more, few).values())
    return out


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('stand_in', metavar='PROGRAM')
    p.add_argument('foot', help='checkpoint of a fit of x3d_foot')
    p.add_argument('chest', help='checkpoint of a fit of chest')
    p.add_argument('--json', type=Path, required=True)
    args = p.parse_args()
    clouds = dict(foot=args.foot, chest=args.chest, giants='giants')
    counts = {name: counted(args.stand_in, cloud) for name, cloud in clouds.items()}
    write_text(args.json, json.dumps(counts, indent=1) + '\n')


if __name__ == '__main__':
    main()
