"""Errors, times and memory of methods that compute the same image.

Errors are relative to `closed_form`, in float64: |found - expected| / |expected| in the L2 norm, and the largest
deviation over the largest expected value. Derivatives are taken of sum(weights * image) with fixed normal weights: their sums
cancel, as for a real residual. Times are medians over rounds in which the methods of a table take turns, so that all run under
the same conditions.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.projectors.balance import SHARING, Sharing
from lingo_mi.validation.accuracy.sizes import Sizes
from lingo_mi.validation.accuracy.workload import Workload
from lingo_mi.validation.closed_form import NAMES

SHORT = 0.1  # seconds; shorter calls depend on what the caches hold


@dataclass
class Method:
    """One way to compute a workload's image.

    Parameters
    ----------
    image : Callable
        () -> Float [pixels], evaluated.
    gradients : Callable or None
        () -> the four derivatives, Dr.Jit arrays or tuples of them, evaluated, forward pass included; or None.
    """

    name: str
    image: Callable
    gradients: Callable | None = None
    times: dict[str, list[float]] = field(default_factory=lambda: dict(forward=[], gradients=[]))


def by_function(name: str, work: Workload, function: Callable, differentiable: bool = True) -> Method:
    """A method from function(centre, scale, rotation, density) -> Float [pixels]."""

    def image():
        out = function(*work.gaussians())
        dr.eval(out)
        return out

    def gradients():
        leaves = work.gaussians()
        dr.enable_grad(leaves)
        dr.backward_from(function(*leaves) * mi.Float(work.weights.ravel()))
        out = [dr.grad(x) for x in leaves]
        dr.eval(out)
        return out

    return Method(name, image, gradients if differentiable else None)


def by_integrator(name: str, work: Workload, sharing: Sharing = SHARING, **settings: Any) -> Method:
    """A method from `lingo_xray` with these parameters, through `mi.render` and `dr.backward`.

    Parameters
    ----------
    sharing : Sharing
        How its work is shared out.
    """
    integrator = mi.load_dict(dict(type='lingo_xray', **settings))
    integrator.options = replace(integrator.options, sharing=sharing)
    params = mi.traverse(work.scene)
    weights = mi.TensorXf(work.weights[..., None])

    def image():
        out = mi.render(work.scene, integrator=integrator).array
        dr.eval(out)
        return out

    def gradients():
        keys = 'cloud.data', 'cloud.density'
        for key in keys:
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0)
        dr.backward(mi.render(work.scene, params, integrator=integrator) * weights)
        out = [dr.grad(params[key]) for key in keys]
        dr.eval(out)
        for key in keys:
            dr.disable_grad(params[key])
        return split(*out)

    return Method(name, image, gradients)


def split(data: Any, density: Any) -> Any:
    """Derivatives by the four parameters from those by the rows of `ellipsoids`."""
    data = data.numpy().reshape(-1, 10)
    return data[:, :3].T, data[:, 3:6].T, data[:, 6:].T, density


def compare(work: Workload, list_of_methods: list[Method], sizes: Sizes) -> list[dict]:
    """Errors, times and memory of methods, one dictionary each."""
    rows = []
    image, gradients = work.truth
    for m in list_of_methods:  # the first calls, which compile
        row: dict = dict(name=m.name)
        result, row['memory_mb'] = peak_memory(m.image)
        row['image'], row['image_max'] = deviation(np.array(result), image)
        if m.gradients:
            result, row['memory_gradients_mb'] = peak_memory(m.gradients)
            for key, by in zip(NAMES, result):
                row[key], row[f'{key}_max'] = deviation(np.array(by).T, gradients[key])
        rows.append(row)
    take_turns(list_of_methods, sizes)
    for m, row in zip(list_of_methods, rows):
        row.update(statistics(m.times))
    return rows


def deviation(result: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Relative L2 and maximum error."""
    result, expected = np.ravel(np.asarray(result, float)), np.ravel(expected)
    error = result - expected
    return (float(np.linalg.norm(error) / np.linalg.norm(expected)), float(abs(error).max() / abs(expected).max()))


def take_turns(list_of_methods: list[Method], sizes: Sizes) -> None:
    """Time all methods in turn, round by round. A short call is repeated, and the second counts: the first finds the caches full
    of another method's data.
    """
    for _ in range(sizes.rounds):
        for m in list_of_methods:
            for key, function in dict(forward=m.image, gradients=m.gradients).items():
                if function and sum(m.times[key]) < sizes.seconds:
                    took = seconds(function)
                    m.times[key].append(took if took > SHORT else seconds(function))


def seconds(function: Callable) -> float:
    """Seconds that a call takes, until the device is done."""
    dr.sync_thread()
    begun = time.perf_counter()
    function()
    dr.sync_thread()
    return time.perf_counter() - begun


def kernel_ms(function: Callable, repeats: int = 5) -> float:
    """Milliseconds that the device computes in a call, without Python and tracing: of `repeats` calls the median."""
    totals = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for _ in range(repeats):
            dr.kernel_history_clear()
            function()
            totals.append(sum(kernel['execution_time'] for kernel in dr.kernel_history()))
    return float(np.median(totals))


def statistics(times: dict) -> dict:
    """Median and quartiles in ms, by what was timed."""
    out = {}
    for key, values in times.items():
        if values:
            out[f'{key}_ms'] = 1e3 * float(np.median(values))
            out[f'{key}_quartiles_ms'] = [1e3 * float(q) for q in np.quantile(values, (0.25, 0.75))]
            out[f'{key}_repeats'] = len(values)
    return out


def peak_memory(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call, and the most MB that Dr.Jit held during it beyond what it held before."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    backend = dr.backend_v(mi.Float)
    before = dr.detail.malloc_watermark(backend)
    out = function()
    dr.sync_thread()
    return out, (dr.detail.malloc_watermark(backend) - before) / 1e6
