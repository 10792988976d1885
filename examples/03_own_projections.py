"""
Your own projections
====================

Measured projections are an array [view, v, u] of line integrals and the geometry of the scanner. They can be handed over as
arrays, or stored as `scan.npy` with the geometry in `scan.yml` beside it.
"""

# %%
# Here are 30 projections as a scanner would deliver them: intensities I, and I0 without an object.

import tempfile
from pathlib import Path

import numpy as np

import lingo_mi as lm

# sphinx_gallery_thumbnail_path = 'figures/inspect.png'

angles = np.radians(np.arange(30) * 12.0)
geometry = lm.Geometry.cone(
    DSO=500, DSD=750, nDetector=(64, 64), dDetector=(2.5, 2.5), grid=lm.Grid(48, 2), angles=angles
)
head = lm.phantom('shepp_logan', size=48)
I0 = 1e5
exact = lm.simulate(0.02 * head.data, geometry).train.projections
counts = np.random.default_rng(0).poisson(I0 * np.exp(-exact))

# %%
# Line integrals are ln(I0 / I). Pixels that counted nothing hold no information: leave them out with a mask.

valid = counts > 0
projections = np.log(I0 / np.maximum(counts, 1))
scan = lm.Scan(geometry, projections, valid)
scan

# %%
# Fit 24 of the views and look at the six that are left.

data = lm.Dataset(scan.subset(np.arange(30) % 5 != 4), scan.subset(np.arange(30) % 5 == 4))
fit = lm.fit(data, 'fast', iterations=300, n_points=4000)
print(f'held-out views: {fit.metrics()["psnr_2d"]:.1f} dB')
fit

# %%
# As files: an array, and the geometry in TIGRE's names. Angles are in degrees in files.

folder = Path(tempfile.mkdtemp())
np.save(folder / 'scan.npy', projections.astype(np.float32))
(folder / 'scan.yml').write_text("""\
DSO: 500                 # source to axis, mm
DSD: 750                 # source to panel, mm
nDetector: [64, 64]      # v, u
dDetector: [2.5, 2.5]    # mm
nVoxel: [48, 48, 48]     # x, y, z
dVoxel: [2, 2, 2]        # mm
totalAngle: 360
""")
loaded = lm.load(folder / 'scan.npy', views=25)
print(len(loaded.train), 'views to fit,', len(loaded.test), 'held out')

# %%
# A geometry that another package has made can be used as it is: see `Geometry.from_tigre`, `from_astra` and `from_rtk`.
