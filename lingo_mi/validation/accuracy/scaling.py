"""Time and memory as the work grows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lingo_mi.validation.accuracy.compare import by_integrator, kernel_ms, peak_memory, statistics, take_turns
from lingo_mi.validation.accuracy.sizes import Sizes
from lingo_mi.validation.accuracy.workload import Workload

SMALL = 60.0  # pixels in a box


def sweeps(sizes: Sizes) -> dict:
    """Time a pair and memory of forward and backward at 3 standard deviations:

    - `pairs`: more and more Gaussians of the same size
    - `small`: the same with boxes of 60 pixels on 256 x 256
    - `gaussians`: more and more, but smaller, ones: the same pairs
    - `pixels`: the same cloud on finer and finer panels
    - `giant`: a cloud without and with one Gaussian as large as all of it
    """
    total = sizes.gaussians * sizes.box
    clouds = dict(
        pairs=[(_count(p, sizes.box), sizes.pixels, sizes.box) for p in sizes.pairs],
        small=[(_count(p, SMALL), 256, SMALL) for p in sizes.pairs],
        gaussians=[(n, 512, min(2 * total / n, 6e4)) for n in sizes.counts],
        pixels=[(sizes.gaussians, side, sizes.box * (side / sizes.pixels) ** 2) for side in sizes.panels],
    )
    out = {name: [_row(Workload(*cloud), sizes) for cloud in each] for name, each in clouds.items()}
    out['giant'] = [_row(Workload(sizes.crowd, sizes.pixels, sizes.box, giant=giant), sizes) for giant in (False, True)]
    return out


def _count(pairs, box):
    return max(round(pairs / box), 1)


def _row(work: Workload, sizes: Sizes) -> dict:
    method = by_integrator('', work, extent=3.0)
    calls: dict[str, Any] = dict(forward=method.image, gradients=method.gradients)
    pairs = work.pairs(3.0)
    row = dict(gaussians=len(work.columns[0]), side=work.pixels, pairs=pairs)
    row |= {
        key: peak_memory(call)[1] for key, call in zip(('memory_mb', 'memory_gradients_mb'), calls.values())
    }  # and compile
    take_turns([method], replace(sizes, rounds=min(sizes.rounds, 5)))
    row |= statistics(method.times)
    for key, call in calls.items():
        row[f'{key}_ns_per_pair'] = 1e6 * row[f'{key}_ms'] / pairs
        row[f'{key}_kernels_ns_per_pair'] = 1e6 * kernel_ms(call) / pairs
    return row
