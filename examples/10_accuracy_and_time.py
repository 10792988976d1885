"""
What accuracy costs
===================

A Gaussian has no end; its footprint is cut off at some standard deviations. That is the one knob of accuracy: 3 is enough to fit
(and what R2-Gaussian uses), 5 is the default for images, 7 leaves float32's own rounding.
"""

# %%
# An image of 4000 Gaussians at cut-offs from 2 to 8, and the time it takes.

import time

import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

rng = np.random.default_rng(0)
count = 4000
cloud = (
    rng.uniform(-60, 60, (count, 3)),
    np.exp(rng.normal(0.7, 0.3, (count, 3))),
    rng.normal(size=(count, 4)),
    rng.uniform(0.1, 1, count),
)
geometry = lm.Geometry.cone(
    DSO=1000, DSD=1500, nDetector=(256, 256), dDetector=(1.2, 1.2), nVoxel=(64,) * 3, dVoxel=(3,) * 3, angles=[0.0]
)
reference = lm.project(*cloud, geometry, extent=9.0)

cutoffs, errors, seconds = [2, 3, 4, 5, 6, 7, 8], [], []
for extent in cutoffs:
    lm.project(*cloud, geometry, extent=extent)  # compiles
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        image = lm.project(*cloud, geometry, extent=extent)
        times.append(time.perf_counter() - begun)
    seconds.append(np.median(times))
    errors.append(np.linalg.norm(image - reference) / np.linalg.norm(reference))

# %%
# Error against time. The full price list, with other methods and with derivatives, is in the accuracy page.

fig, axis = plt.subplots(figsize=(6, 4), layout='constrained')
axis.loglog(1e3 * np.array(seconds), errors, 'o-')
for extent, x, y in zip(cutoffs, seconds, errors):
    axis.annotate(f'{extent} σ', (1e3 * x, y), textcoords='offset points', xytext=(6, 4))
axis.set(xlabel='time of an image [ms]', ylabel='relative error of the image')
axis.grid(alpha=0.3)
