"""The time on a graphics card that follows from counted instructions and sectors, and from the card's data sheet. A prediction.

A kernel takes as long as the resource that it needs longest, and no less than a launch:

    issue     4 instructions of warps a clock and multiprocessor
    fp32 ...  lanes a clock and multiprocessor, by kind of instruction
    atomics   ATOMICS sectors a clock and multiprocessor, as many as the L2 cache of an A100 has slices: an assumption
    memory    loads and stores, all from and to the card's memory, as if nothing were cached

Nothing waits for anything in this model, so that times are lower bounds; published kernels reach half to four fifths of such.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources

from lingo_mi.common.gpu import GPU, gpu

ATOMICS = 0.74  # sectors a clock and multiprocessor
LAUNCH = 3e-6  # seconds
WARP, SECTOR, ISSUE = 32, 32, 4

# Lanes of a multiprocessor by compute capability: float32, integers, float64 (CUDA C++ Programming Guide, table of throughputs).
LANES = {75: (64, 64, 2), 80: (64, 64, 32), 86: (128, 64, 2), 89: (128, 64, 2), 90: (128, 64, 64), 120: (128, 128, 2)}
SPECIAL = 16  # lanes for reciprocals, roots and powers


@dataclass(frozen=True)
class Card:
    """A graphics card, by its data sheet: multiprocessors, boost clock in Hz, memory in bytes a second, compute capability."""

    name: str
    multiprocessors: int
    clock: float
    bandwidth: float
    capability: int

    @classmethod
    def of(cls, gpu: GPU) -> Card:
        """The card that the driver describes."""
        return cls(gpu.name, gpu.multiprocessors, gpu.clock, gpu.bandwidth, gpu.capability)


CARDS = (
    Card('RTX 3090', 82, 1.695e9, 936e9, 86),
    Card('A100 80 GB', 108, 1.41e9, 2039e9, 80),
    Card('H100 SXM', 132, 1.98e9, 3350e9, 90),
)


def times(kernel: dict, card: Card) -> dict[str, float]:
    """Seconds that a kernel needs each resource. kernel   as `count.difference` gives it"""
    warp, clocks = kernel['warp'], card.multiprocessors * card.clock
    older = [capability for capability in LANES if capability <= card.capability]
    fp32, integers, fp64 = LANES[max(older)] if older else LANES[75]
    lanes = dict(fp32=fp32, int=integers, fp64=fp64, mufu=SPECIAL)
    return dict(
        issue=sum(warp.values()) / (ISSUE * clocks),
        **{kind: warp[kind] * WARP / (n * clocks) for kind, n in lanes.items()},
        atomics=kernel['atomics'] / (ATOMICS * clocks),
        memory=(kernel['loads'] + kernel['stores']) * SECTOR / card.bandwidth,
    )


def seconds(kernel: dict, card: Card) -> float:
    """Seconds of all launches of a kernel."""
    return max(*times(kernel, card).values(), LAUNCH * kernel['launches'])


def largest(kernels: Iterable[dict]) -> dict:
    """The kernel with the most instructions: that over the pairs of pixels and Gaussians."""
    return max(kernels, key=lambda kernel: sum(kernel['warp'].values()))


def counts() -> dict:
    """The counts that are kept with the package, by cloud."""
    return json.loads((resources.files('lingo_mi.validation') / 'cuda_counts.json').read_text())


def predicted(part: str, card: Card, gaussians: int, boxes: float) -> float:
    """Seconds of a part ('image', 'derivatives' or 'step') for other work, from the counts of the foot.

    Parameters
    ----------
    boxes : float
        Pairs of a Gaussian and a pixel of its box (`pairs.count_pairs`): the time of the largest kernels is in proportion to
        them, the time of the others to the Gaussians.
    """
    foot = counts()['foot']
    per_pair, per_gaussian = boxes / foot['boxes'], gaussians / foot['gaussians']
    main = [largest(foot['image']), largest(foot['derivatives'])]
    instructions = [sum(kernel['warp'].values()) for kernel in main]
    total = 0.0
    for kernel in foot[part]:
        of_pairs = sum(kernel['warp'].values()) >= 0.5 * min(instructions)
        total += seconds(kernel, card) * (per_pair if of_pairs else per_gaussian)
    return total


def beside(what: str, part: str, measured: float, gaussians: int, boxes: float | None = None) -> str:
    """A line with a measured time on this GPU, seconds, and the predicted one; arguments as for `predicted`.

    Parameters
    ----------
    boxes : float or None
        None: as many a Gaussian as in the foot.
    """
    foot = counts()['foot']
    card = Card.of(gpu())
    if not card.clock:
        return f'{what}: {1e3 * measured:.2f} ms; no prediction, as the driver of {card.name} does not say its clock'
    expected = predicted(
        part, card, gaussians, foot['boxes'] / foot['gaussians'] * gaussians if boxes is None else boxes
    )
    return f'{what}: {1e3 * measured:.2f} ms; predicted for {card.name}: {1e3 * expected:.2f} ms or more (docs/gpu.md)'
