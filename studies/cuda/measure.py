"""Times of a fit's image, derivatives and steps, as the device measures its kernels and as a clock measures the steps.

    lingo-mi fit x3d_foot --out out/foot
    python -m studies.cuda.measure out/foot/checkpoint.npz

On a GPU the times that the model predicts stand beside.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.common.gpu import gpu
from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fit import Fit, load_fit
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.view import View
from lingo_mi.scan import Scan
from lingo_mi.validation.cuda_model import Card, counts, predicted
from lingo_mi.validation.markdown import table
from studies.cuda.work import VIEW, image

WARM = 5
SHORT = 0.05  # ms


def kernels(work: Callable[[], object]) -> dict:
    """Launches of some work, their milliseconds, and the same of those shorter than SHORT."""
    work()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work()
        dr.sync_thread()
        taken = [kernel['execution_time'] for kernel in dr.kernel_history()]
    short = [ms for ms in taken if ms < SHORT]
    return dict(launches=len(taken), all=sum(taken), short=len(short), of_short=sum(short))


def measured(fit: Fit, repeats: int) -> dict[str, dict]:
    """Measure an image with its derivatives and a step: `kernels`; for a step also `seconds`, each in a row of many."""
    view = VIEW % len(fit.nominal_geometry)
    geometry, rng = fit.nominal_geometry.subset([view]), np.random.default_rng(0)
    scan = Scan(geometry, rng.uniform(1, 2, (1, *geometry.nDetector)).astype(np.float32))
    stepper, state = fit.method.stepper(scan), DeviceState(fit.state)
    *vectors, density = (np.asarray(x, np.float32) for x in fit.gaussians)
    types = mi.Point3f, mi.Vector3f, mi.Vector4f
    gaussians = [*(Type(*map(uploaded, x.T)) for Type, x in zip(types, vectors)), uploaded(density)]
    rays = View.of(geometry.rays(), 0, *geometry.nDetector)

    def step():
        stepper.step(state, [0], fit.method.iterations - 1, rng)

    for _ in range(WARM):
        step()
    dr.sync_thread()
    begun = time.perf_counter()
    for _ in range(repeats):
        step()
    dr.sync_thread()
    seconds = (time.perf_counter() - begun) / repeats
    return {
        'image and derivatives': kernels(lambda: image([dr.detach(x) for x in gaussians], rays, derivatives=True)),
        'a step': kernels(step) | dict(seconds=seconds),
    }


def expected(gaussians: int) -> dict[str, float]:
    """Milliseconds of the same work by the model, with as many pairs a Gaussian as in the foot; empty for an unknown card."""
    card, foot = Card.of(gpu()), counts()['foot']
    if not card.clock:
        return {}
    parts = {'image and derivatives': ('image', 'derivatives'), 'a step': ('step',)}
    boxes = foot['boxes'] / foot['gaussians'] * gaussians
    return {name: 1e3 * sum(predicted(part, card, gaussians, boxes) for part in of) for name, of in parts.items()}


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('checkpoint', help='checkpoint of a fit')
    p.add_argument('--repeats', type=int, default=100, help='steps in a row')
    p.add_argument('--variant', metavar='V')
    args = p.parse_args()
    variant = use_variant(args.variant)
    fit = load_fit(args.checkpoint)
    results = measured(fit, args.repeats)
    model = expected(len(fit)) if variant.startswith('cuda') else {}
    columns = [
        ('work', lambda row: row[0]),
        ('launches', lambda row: f'{row[1]["launches"]}'),
        ('kernels, ms', lambda row: f'{row[1]["all"]:.2f}'),
        ('the model, ms', lambda row: f'{model[row[0]]:.2f}' if model else ''),
        ('short kernels', lambda row: f'{row[1]["short"]}'),
        ('those, ms', lambda row: f'{row[1]["of_short"]:.2f}'),
        ('in a row, ms', lambda row: f'{1e3 * row[1]["seconds"]:.2f}' if 'seconds' in row[1] else ''),
    ]
    print(table(columns, results.items()))  # type: ignore[arg-type] - rows of any kind do


if __name__ == '__main__':
    main()
