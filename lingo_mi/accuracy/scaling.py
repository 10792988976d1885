"""Time and memory as the work grows."""
from __future__ import annotations

from dataclasses import replace

from .compare import by_integrator, peak_memory, statistics, take_turns
from .sizes import Sizes
from .workload import Workload


def sweeps(sizes: Sizes) -> dict:
    """Time a pair and memory of forward and backward at 3 standard deviations, in three sweeps:

    pairs       more and more Gaussians of the same size
    gaussians   more and more, but smaller, ones: the same pairs
    pixels      the same cloud on finer and finer panels
    """
    total = sizes.gaussians * sizes.box
    clouds = dict(
        pairs=[(p, max(round(p / sizes.box), 1), sizes.pixels, sizes.box) for p in sizes.pairs],
        gaussians=[(n, n, 512, min(2 * total / n, 6e4)) for n in sizes.counts],
        pixels=[(side, sizes.gaussians, side, sizes.box * (side / sizes.pixels) ** 2) for side in sizes.panels])
    out = {}
    for name, points in clouds.items():
        out[name] = []
        for x, n, side, box in points:
            work = Workload(n, side, box)
            method = by_integrator(name, work, extent=3.)
            memory = [peak_memory(f)[1] for f in (method.image, method.gradients)]  # and compile
            take_turns([method], replace(sizes, rounds=min(sizes.rounds, 5)))
            pairs = work.pairs(3.)
            row = statistics(method.times)
            row |= dict(x=float(x), gaussians=n, side=side, pairs=pairs, memory_mb=memory[0],
                        memory_gradients_mb=memory[1])
            for key in ('forward', 'gradients'):
                row[f'{key}_ns_per_pair'] = 1e6 * row[f'{key}_ms'] / pairs
            out[name].append(row)
    return out
