"""
A method of your own
====================

A start, a loss and a method are dataclasses. Yours derive from these and work like any other: by name, with options, in files.
"""

# %%
# The start places the Gaussians: here on a lattice, with the density that explains the first view. Lengths are in units of half
# the volume's longest side; `render` projects a cloud.

import tempfile
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

import lingo_mi as lm


@dataclass(frozen=True)
class LatticeStart(lm.Start):
    name: ClassVar = 'lattice'
    RANGES: ClassVar = dict(n_points=(1, 1e6))
    n_points: int = 4000

    def cloud(self, scan, rng, render, unit):
        half = scan.geometry.grid.half
        step = 2 * (np.prod(half) / self.n_points) ** (1 / 3)
        axes = [np.arange(step / 2 - side, side, step) for side in half]
        points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
        ones, spacing = np.ones(len(points)), np.full(len(points), step / 2)
        density = scan.normalised[0].sum() / render(points, ones, spacing, [0]).sum()
        return lm.StartingCloud(points, density * ones, spacing)


# %%
# The loss compares a rendered view with the measured one. The method puts the parts together; what it does not name is
# R2-Gaussian's.


@dataclass(frozen=True)
class RootMeanSquare(lm.Loss):
    def value(self, image, measured, height, width):
        return dr.sqrt(dr.mean(dr.square(image - measured)))


@dataclass(frozen=True)
class MyMethod(lm.DensityMethod):
    name: ClassVar = 'my-method'
    iterations: int = 300
    rates: lm.DensityRates = lm.Fast.rates
    start: lm.Start = LatticeStart()
    loss: lm.Loss = RootMeanSquare()
    normalise: bool = True


# %%
# As an object, by name, and read from files.

data = lm.simulate(lm.phantom('foot', size=48), views=20)
fit = lm.fit(data, MyMethod())
small = lm.fit(data, 'my-method:n_points=2000', iterations=100)
again = lm.load_fit(fit.save(tempfile.mkdtemp()))
print(again, small, f'{again.metrics()["psnr_3d"]:.1f} dB', sep='\n')
again
