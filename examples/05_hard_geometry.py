"""
A helix with wrong poses
========================

The scanner need not move on a circle. Here it climbs along a helix, and every view is off by half a degree and a millimetre,
which nobody has told the fit. It corrects the poses while it fits.
"""

# %%
# The true scanner: two turns that climb 60 mm each.

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import lingo_mi as lm

foot = lm.phantom('foot', size=48)
angles = np.linspace(-2 * np.pi, 2 * np.pi, 36, endpoint=False)
scanner = dict(
    DSO=1000, DSD=1500, nDetector=(72, 72), dDetector=(8, 8), nVoxel=foot.data.shape, dVoxel=foot.spacing, angles=angles
)
told = lm.Geometry.helix(pitch=60, **scanner)

# %%
# What it really does: every view is turned and shifted a little.

rng = np.random.default_rng(1)
turn = Rotation.from_rotvec(np.radians(rng.normal(0, 0.5, (36, 3)))).as_matrix()
real = lm.Geometry.from_poses(
    told.rays().moved(turn, rng.normal(0, 1, (36, 3))), told.nDetector, nVoxel=told.nVoxel, dVoxel=told.dVoxel
)
measured = lm.simulate(foot, real).train.projections
scan = lm.Scan(told, measured)

# %%
# Two fits of the same projections: poses as told, and poses corrected (`rate_pose`: first and last step size).

plain = lm.fit(scan, 'fast', iterations=400, n_points=4000)
corrected = lm.fit(scan, 'fast', iterations=400, n_points=4000, rate_pose=(2e-3, 2e-4))

fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout='constrained')
for axis, image, title in zip(
    axes, (foot.data, plain.volume(), corrected.volume()), ('truth', 'poses as told', 'poses corrected')
):
    axis.imshow(image[:, :, 16].T, origin='lower', cmap='gray', vmin=0, vmax=1)
    axis.set(title=title, xticks=[], yticks=[])

# %%
# The residual in the measured views says the same without the truth.

for name, result in (('as told', plain), ('corrected', corrected)):
    rms = np.sqrt(np.mean((result.render(result.geometry) - measured) ** 2))
    print(f'{name:10s} rms of line integrals {rms:.3f}')
