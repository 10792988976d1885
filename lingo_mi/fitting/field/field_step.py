"""One step of the fit of a neural field: integrate it along a few rays of a view, and compare with the measured pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lingo_mi.fitting.adam import adam_step
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field.densities import largest_density, mean_density
from lingo_mi.fitting.field.field_model import FieldModel
from lingo_mi.fitting.field.options import Field
from lingo_mi.fitting.field.rays import pixels_of
from lingo_mi.fitting.method import Method, Stepper
from lingo_mi.fitting.state import State
from lingo_mi.projectors.grid import view_table
from lingo_mi.projectors.upload import uploaded
from lingo_mi.scan import Scan

MOST_COPIES = 2**30  # bytes of the copies of the gradient, one for each thread


class FieldStepper(Stepper):
    """The optimisation of a field on one scan, step by step."""

    model: FieldModel

    def __init__(self, method: Method, options: Field, normalise: bool, scan: Scan):
        """options: of the field; normalise: as for `NAF`. Raises InputError for an empty scan."""
        self.method, self.options, self.scan, self.geometry = method, options, scan, scan.geometry
        self.model = FieldModel(options, scan.geometry, largest_density(scan) if normalise else 1.0)
        self.rows = view_table(scan.geometry)

    def begin(self, seed: int) -> tuple[State, np.ndarray, dict]:
        """Random parameters, and no points."""
        rng = np.random.default_rng(seed).spawn(1)[0]  # leaves the steps' random numbers as they are
        mean = mean_density(self.scan) / self.model.unit if self.options.field_start == 'mean' else None
        values = self.model.network.initial(rng, mean)
        first, second = ({k: np.zeros_like(v) for k, v in values.items()} for _ in range(2))
        none = np.zeros(0, np.float32)
        state = State(values, first, second, none, none.copy(), np.zeros(0, bool))
        return state, np.zeros((0, 3), np.float32), {}

    def step(self, state: DeviceState, views: Sequence[int], iteration: int, rng: np.random.Generator) -> Any:
        """Advance the state by one Adam step on random rays of the given views. Returns the loss, Float [1].

        `iteration` counts from 0. `rng` chooses the rays, and the samples on them.
        """
        s = self.options
        for value in state.values.values():
            dr.enable_grad(value)
        total = mi.Float(0)
        with _private_copies(sum(dr.width(v) for v in state.values.values())):
            for view in views:
                pixels = self._pixels(view, rng)
                if not len(pixels):
                    continue
                x, y = map(uploaded, pixels_of(pixels, self.scan.geometry.nDetector[1]))
                within = uploaded(rng.random(s.field_samples * len(pixels), np.float32))
                scale = np.float32(self.scan.geometry.grid.scale / self.model.unit)
                measured = uploaded(self.scan.projections[view].ravel()[pixels] * scale)
                rendered = self.model.integrals(state.values, uploaded(self.rows[view]), x, y, within)
                loss = dr.mean(dr.square(rendered - measured)) / len(views)
                dr.backward(loss)
                total += dr.detach(loss)
                dr.eval(total, *(dr.grad(v) for v in state.values.values()))
        gradients = {name: dr.grad(value) for name, value in state.values.items()}
        adam_step(state, gradients, self.method, iteration)
        return total

    def _pixels(self, view: int, rng: np.random.Generator) -> np.ndarray:
        """Flat indices of `field_rays` valid pixels of a view behind the object, whose line integral is above 0 (NAF).

        If there are fewer, some are taken more than once; of a view that shows nothing, any valid pixels. None of a view
        without those.
        """
        pixels = self.scan.projections[view].ravel()
        valid = np.ones(len(pixels), bool) if self.scan.valid is None else self.scan.valid[view].ravel()
        behind = np.flatnonzero(valid & (pixels > 0))
        if not len(behind):
            behind = np.flatnonzero(valid)
        n = self.options.field_rays if len(behind) else 0
        return rng.choice(behind, n, replace=len(behind) < n, shuffle=False)


@contextmanager
def _private_copies(size: int) -> Iterator[None]:
    """On the CPU, derivatives by so many parameters are summed in a copy for each thread, while that is not too much memory:
    half the time of atomic sums. A GPU has no such copies."""
    before = dr.expand_threshold()
    if 4 * size * dr.thread_count() <= MOST_COPIES:
        dr.set_expand_threshold(max(size + 1, before))
    try:
        yield
    finally:
        dr.set_expand_threshold(before)
