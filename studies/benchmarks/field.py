"""Time of a step of a neural field, beside the same step in hand-written NumPy.

    python -m studies.benchmarks.field
    python -m studies.benchmarks.field --rays 256 --samples 96 --repeats 10

Both encode random rays' samples, run the network, sum along the rays, backpropagate the mean squared error to all parameters and
take one step of Adam, at NAF's published size. They run in turns; the ratio is taken of the medians over all turns, of seconds of
CPU and of seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import drjit as dr
import numpy as np

from lingo_mi.common.runtime import use_variant
from lingo_mi.fitting.device_state import DeviceState
from lingo_mi.fitting.field.options import Field
from lingo_mi.fitting.methods.naf import NAF
from lingo_mi.fitting.state import State
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.scan import Scan

WARM = 2  # turns that are not counted
PRIMES = 1, 2654435761, 805459861  # of the hash (Müller et al., equation 4)
SLOPE = 0.01


def main() -> None:
    p = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    p.add_argument('--rays', type=int, default=1024)
    p.add_argument('--samples', type=int, default=192)
    p.add_argument('--repeats', type=int, default=5, help='turns')
    p.add_argument('--variant', help='Mitsuba variant')
    args = p.parse_args()
    variant = use_variant(args.variant)
    results = measured(args.rays, args.samples, args.repeats)
    (ours, our_cpu), (numpy, numpy_cpu) = results
    print(
        f'{variant}, {args.rays} rays x {args.samples} samples: Dr.Jit {our_cpu:.2f} s of CPU ({ours:.2f} s), NumPy '
        f'{numpy_cpu:.2f} s of CPU ({numpy:.2f} s), ratio {our_cpu / numpy_cpu:.2f} ({ours / numpy:.2f})'
    )


def measured(rays: int, samples: int, repeats: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Medians of seconds, and of seconds of CPU, of a step: by Dr.Jit, and by NumPy."""
    method = NAF().changed(field_rays=rays, field_samples=samples)
    geometry = CircularGeometry(
        DSO=500.0, DSD=750.0, nDetector=(64, 64), dDetector=(6.0, 6.0), angles=circular(4, 180), grid=Grid(64, 4.0)
    )
    rng = np.random.default_rng(0)
    scan = Scan(geometry, rng.random((4, 64, 64), np.float32))
    stepper = method.stepper(scan)
    begin, *_ = stepper.begin(0)
    on_device = DeviceState(begin)
    by_numpy = NumpyField(method.field, begin)

    def native(turn):
        stepper.step(on_device, [turn % 4], turn, rng)
        dr.sync_thread()

    def written(turn):
        points = rng.random((rays * samples, 3), np.float32)
        by_numpy.step(points, np.float32(1 / samples), rng.random(rays, np.float32), turn)

    times: dict[Callable, list] = {native: [], written: []}
    for turn in range(WARM + repeats):
        for work, spent in times.items():
            began, cpu = time.perf_counter(), time.process_time()
            work(turn)
            spent.append((time.perf_counter() - began, time.process_time() - cpu))
    ours, theirs = (tuple(np.median(spent[WARM:], 0).tolist()) for spent in times.values())
    return ours, theirs


class NumpyField:
    """The field of `fitting.field.network.Network` and a step of its fit, written by hand in NumPy.

    Parameters
    ----------
    dtype : type
        Type of all computations: float32 to be measured, float64 to be compared with.
    """

    def __init__(self, options: Field, state: State, dtype: type = np.float32):
        s = self.options = options
        self.dtype = dtype
        self.features = state.values['features'].reshape(-1, s.field_features).astype(dtype)
        flat, self.layers = state.values['network'][:, 0].astype(dtype), []
        inputs, begin = s.field_levels * s.field_features, 0
        for i in range(s.field_layers):
            n = (inputs if i == 0 else s.field_width) + (inputs if i == s.field_skip else 0)
            m = 1 if i == s.field_layers - 1 else s.field_width
            matrix, bias = flat[begin : begin + n * m].reshape(m, n), flat[begin + n * m : begin + n * m + m]
            self.layers.append((matrix, bias))
            begin += n * m + m
        self.moments = [np.zeros((2, *x.shape), dtype) for x in self.parameters()]

    def parameters(self) -> list[np.ndarray]:
        """Features [entries, size], then matrix [m, n] and bias [m] of each layer."""
        return [self.features, *(x for layer in self.layers for x in layer)]

    def corners(self, points: np.ndarray):
        """Per level: indices of the eight corners of each point's cell, [8, N], and their weights."""
        s, offset = self.options, 0
        for level in range(s.field_levels):
            scale = s.field_base * s.field_growth**level - 1
            side = int(np.ceil(scale)) + 1
            size = min(side**3 + side**3 % s.field_features, s.field_entries)
            at = points.astype(self.dtype) * self.dtype(scale) + self.dtype(0.5)
            cell = np.floor(at)
            far = (at - cell).T
            cell = cell.astype(np.uint32).T
            index, weight = [], []
            for corner in range(8):
                bits = [corner >> axis & 1 for axis in range(3)]
                x = [c + np.uint32(b) for c, b in zip(cell, bits)]
                if side**3 <= size:
                    flat = x[0] + x[1] * np.uint32(side) + x[2] * np.uint32(side * side)
                else:
                    flat = x[0] ^ x[1] * np.uint32(PRIMES[1]) ^ x[2] * np.uint32(PRIMES[2])
                index.append(offset + flat % np.uint32(size))
                weight.append(np.prod([f if b else 1 - f for f, b in zip(far, bits)], 0))
            offset += size
            yield np.stack(index), np.stack(weight)

    def density(self, points: np.ndarray) -> np.ndarray:
        """The field at points [N, 3] in [0, 1], [N]; keeps what `gradients` needs."""
        self.corner_weights = list(self.corners(points))
        encoded = [np.einsum('cn,cnf->nf', w, self.features[i]) for i, w in self.corner_weights]
        inputs = np.concatenate(encoded, 1)
        hidden, self.into, self.signs = inputs, [], []
        for k, (matrix, bias) in enumerate(self.layers):
            if k == self.options.field_skip:
                hidden = np.concatenate([inputs, hidden], 1)
            self.into.append(hidden)
            hidden = hidden @ matrix.T + bias
            if k < len(self.layers) - 1:
                self.signs.append(np.where(hidden > 0, self.dtype(1), self.dtype(SLOPE)))
                hidden = hidden * self.signs[-1]
        self.value = 1 / (1 + np.exp(-hidden[:, 0]))
        return self.value

    def gradients(self, by_density: np.ndarray) -> list[np.ndarray]:
        """Derivatives by all `parameters`, from those by the densities, [N], of the last call."""
        out: list[np.ndarray] = []
        g = (by_density * self.value * (1 - self.value))[:, None]
        inputs = self.options.field_levels * self.options.field_features
        by_inputs = np.zeros((len(g), inputs), self.dtype)
        for k in reversed(range(len(self.layers))):
            if k < len(self.layers) - 1:
                g = g * self.signs[k]
            out = [g.T @ self.into[k], g.sum(0), *out]
            g = g @ self.layers[k][0]
            if k == self.options.field_skip:
                by_inputs, g = by_inputs + g[:, :inputs], g[:, inputs:]
        by_inputs = by_inputs + g
        by_features = np.zeros_like(self.features)
        size, entries = self.options.field_features, len(self.features)
        for level, (index, weight) in enumerate(self.corner_weights):
            for f in range(size):
                values = weight * by_inputs[:, level * size + f]
                by_features[:, f] += np.bincount(index.ravel(), values.ravel(), entries).astype(self.dtype)
        return [by_features, *out]

    def step(self, points: np.ndarray, length: np.floating, measured: np.ndarray, iteration: int) -> None:
        """One step of Adam on the mean squared error of line integrals; `length` of a sample's part of its ray."""
        rays = len(measured)
        density = self.density(points).reshape(rays, -1).sum(1) * length
        by_ray = 2 / rays * (density - measured) * length
        gradients = self.gradients(np.repeat(by_ray, len(points) // rays))
        c1, c2 = 1 - 0.9 ** (iteration + 1), 1 - 0.999 ** (iteration + 1)
        for x, g, moments in zip(self.parameters(), gradients, self.moments):
            moments[0] += self.dtype(0.1) * (g - moments[0])
            moments[1] += self.dtype(0.001) * (g * g - moments[1])
            x -= self.dtype(1e-3) * (moments[0] / c1) / (np.sqrt(moments[1] / c2) + self.dtype(6e-7))


if __name__ == '__main__':
    main()
