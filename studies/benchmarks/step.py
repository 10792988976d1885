"""Time of the parts of a fit's step.

Steps from the end of a fit, on views with random pixels. The parts of the loss are switched off one by one: what a step then
saves is their time. All kinds of work run in turns on the same view, so that all see the same machine; medians over the turns, of
differences within a turn. Densification counts with its share of a step.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.adam import adam_step
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.methods.densities import DensityMethod
from lingo_mi.fitting.options.loss import Loss
from lingo_mi.projectors.cloud import line_integrals
from lingo_mi.projectors.options import RenderOptions
from lingo_mi.scan import Scan
from lingo_mi.validation.markdown import table

WARM = 3  # turns that are not counted
VIEWS = 4  # at most
LOSS = {  # parts of the loss by the options of their weights
    'gradient of the difference': 'lambda_gradient',
    'SSIM': 'lambda_ssim',
    'total variation': 'lambda_tv',
}


def measured(fit: Fit, repeats: int) -> dict[str, float]:
    """Seconds of each part of a step, of a whole one, and of the integrator alone."""
    method, state, nominal = fit.method, DeviceState(fit.state), fit.nominal_geometry
    assert isinstance(method, DensityMethod)  # others have other parts
    views = min(VIEWS, len(nominal))
    every = len(nominal) // views
    geometry, rng = nominal.subset(slice(0, views * every, every)), np.random.default_rng(0)
    scan = Scan(geometry, rng.uniform(1, 2, (views, *geometry.nDetector)).astype(np.float32))
    steppers = {'whole': method.stepper(scan)}
    for part in _parts_of_the_loss(method.loss):
        steppers[part] = method.changed(**{LOSS[part]: 0.0}).stepper(scan)
    late, upstream = method.iterations - 1, dr.opaque(mi.Float, 1, int(np.prod(geometry.nDetector)))
    gradients = {name: dr.zeros(type(x), dr.width(x)) for name, x in state.values.items()}
    dr.eval(gradients)

    def integrate(turn, backward):
        gaussians = [dr.detach(x) for x in steppers['whole'].forward.gaussians(state.values)]
        view = steppers['whole'].targets[turn % views].view
        if backward:
            dr.enable_grad(gaussians)
        image = line_integrals(*gaussians, view=view, options=RenderOptions(method.extent))
        if not backward:
            return dr.eval(image)
        dr.backward(image * upstream)
        return dr.eval([dr.grad(x) for x in gaussians])

    work: dict[str, Callable[[int], object]] = {
        'image': lambda turn: integrate(turn, backward=False),
        'image and derivatives': lambda turn: integrate(turn, backward=True),
        'Adam': lambda _: adam_step(state, gradients, method, late),
        **{name: lambda turn, s=s: s.step(state, [turn % views], late, rng) for name, s in steppers.items()},
    }
    times: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(WARM + repeats):
        for name, do in work.items():
            dr.sync_thread()
            began = time.perf_counter()
            do(turn)
            dr.sync_thread()
            times[name].append(time.perf_counter() - began)
    taken = {name: np.array(seconds[WARM:]) for name, seconds in times.items()}
    whole = taken['whole']
    parts = {
        'integrator, forward': taken['image'],
        'integrator, backward': taken['image and derivatives'] - taken['image'],
        **{part: whole - taken[part] for part in LOSS if part in taken},
        'Adam': taken['Adam'],
        'a step': whole,
    }
    medians = {name: float(np.median(seconds)) for name, seconds in parts.items()}
    step = medians.pop('a step')
    medians['the rest'] = step - sum(medians.values())
    return medians | {'a step': step, 'densification': _renewal(steppers['whole'], state, rng)}


def _parts_of_the_loss(loss: Loss) -> list[str]:
    """Return the parts of LOSS that the method has and can do without: another part must compare with the projections."""
    compared = loss.lambda_l1 + loss.lambda_ssim + loss.lambda_gradient
    weights = {part: getattr(loss, name) for part, name in LOSS.items()}
    return [part for part, weight in weights.items() if weight > 0 and (weight < compared or LOSS[part] == 'lambda_tv')]


def _renewal(stepper, state, rng):
    """Seconds of densification, spread over all steps of the fit."""
    s, iterations = stepper.method.densify, stepper.method.iterations
    due = [i for i in range(s.densify_from + 1, min(s.densify_until, iterations)) if i % s.densify_every == 0]
    if not due:
        return 0.0
    began = time.perf_counter()
    stepper.densified(state, due[-1], rng)
    dr.sync_thread()
    return (time.perf_counter() - began) * len(due) / iterations


def described(medians: dict[str, float]) -> str:
    """A Markdown table, and how a step compares with the integrator alone."""
    whole = medians['a step']
    rows = table(
        [
            ('part', lambda row: row[0]),
            ('ms', lambda row: f'{row[1] * 1e3:.1f}'),
            ('of a step', lambda row: f'{100 * row[1] / whole:.0f} %'),
        ],
        medians.items(),  # type: ignore[arg-type] - rows of any kind do
    )
    ratio = whole / (medians['integrator, forward'] + medians['integrator, backward'])
    return f'{rows}\n\nA step takes {ratio:.2f} times as long as the integrator, forward and backward.'
