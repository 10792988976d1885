"""
The cost of accuracy
====================

A Gaussian has no end; its footprint is cut off at some standard deviations. That is the one knob of accuracy: 3 is enough to fit
(and what R2-Gaussian uses), 5 is the default for images, 7 leaves float32's own rounding.
"""

# %%
# An image of 30,000 Gaussians at cut-offs from 2 to 8: how much it differs from the image at 9, and the time it takes.

import time

import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

rng = np.random.default_rng(0)
count = 30_000
cloud = (
    rng.uniform(-60, 60, (count, 3)),
    np.exp(rng.normal(0.7, 0.3, (count, 3))),  # 2 mm
    rng.normal(size=(count, 4)),
    rng.uniform(0.1, 1, count),
)
geometry = lm.Geometry.cone(
    DSO=1000, DSD=1500, nDetector=(512, 512), dDetector=(0.6, 0.6), grid=lm.Grid(64, 3), angles=[0.0]
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
    seconds.append(min(times))
    errors.append(np.linalg.norm(image - reference) / np.linalg.norm(reference))

# %%
# The error falls with the tail of a Gaussian, down to rounding; the time grows with the area of the footprints. The full price
# list, with other methods and with derivatives, is in the accuracy page.

fig, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout='constrained')
axes[0].semilogy(cutoffs, errors, 'o-')
axes[0].set(xlabel='cut-off [standard deviations]', ylabel='relative error of the image')
axes[1].plot(cutoffs, 1e3 * np.array(seconds), 'o-')
axes[1].set(xlabel='cut-off [standard deviations]', ylabel='time of an image [ms]', ylim=(0, None))
for axis in axes:
    axis.grid(alpha=0.3)
