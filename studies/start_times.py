"""Time the starts of LINGO and of R2-Gaussian at the paper's size: `python -m studies.start_times`.

The foot has 256³ voxels and 25 views of 512 x 512 pixels, and the cloud has 50,000 points. Each time is a median of five starts
after one that compiles the kernels. The paper reports 0.47 s for masks with voxel scaling, 5.76 s without it, and 1.42 s for FDK.
Run it on a machine that does nothing else.
"""

from __future__ import annotations

import statistics
import time

import lingo_mi as lm
from lingo_mi.cli.common import Parser
from lingo_mi.fitting.methods.densities import DensityMethod
from lingo_mi.scan import Scan
from studies.command import run_study

PAPER = {'masks': 0.47, 'masks without scaling': 5.76, 'FDK': 1.42}  # seconds
REPEATS = 5


def methods() -> dict[str, DensityMethod]:
    """The methods whose starts the paper times, by their names in the table."""
    lingo = lm.LINGO().changed(density='paper')  # the paper renders nothing to start
    return {'masks': lingo, 'masks without scaling': lingo.changed(V_S=1), 'FDK': lm.R2()}


def seconds(method: DensityMethod, scan: Scan) -> list[float]:
    """The times of five starts, after one that compiles the kernels."""
    times = []
    for _ in range(REPEATS + 1):
        before = time.perf_counter()
        method.starting_cloud(scan)
        times.append(time.perf_counter() - before)
    return times[1:]


def main() -> None:
    Parser(description=__doc__).parse_args()
    scan = lm.simulate('x3d_foot', views=25).train
    print('| start | s, median | least | most | paper, s |\n|---|---:|---:|---:|---:|')
    for name, method in methods().items():
        times = seconds(method, scan)
        print(f'| {name} | {statistics.median(times):.2f} | {min(times):.2f} | {max(times):.2f} | {PAPER[name]} |')


if __name__ == '__main__':
    run_study('start_times', main)
