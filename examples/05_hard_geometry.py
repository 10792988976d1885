"""
A helix with wrong poses
========================

The scanner need not move on a circle. Here it climbs along a helix, and every view is off by about a degree and two millimetres,
of which the fit is told nothing. It corrects the poses while it fits.
"""

# %%
# The true scanner: two turns that climb 60 mm each.

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import lingo_mi as lm

foot = lm.phantom('foot', size=64)
angles = np.linspace(-2 * np.pi, 2 * np.pi, 36, endpoint=False)
scanner = dict(
    DSO=1000, DSD=1500, nDetector=(96, 96), dDetector=(6, 6), nVoxel=foot.data.shape, dVoxel=foot.spacing, angles=angles
)
told = lm.Geometry.helix(pitch=60, **scanner)

# %%
# What it really does: every view is turned and shifted a little.

rng = np.random.default_rng(1)
turn = Rotation.from_rotvec(np.radians(rng.normal(0, 1, (36, 3)))).as_matrix()
real = lm.Geometry.from_poses(
    told.rays().moved(turn, rng.normal(0, 2, (36, 3))), told.nDetector, nVoxel=told.nVoxel, dVoxel=told.dVoxel
)
measured = lm.simulate(foot, real).train.projections
data = lm.Dataset(lm.Scan(told, measured), volume=foot.data)

# %%
# Two fits of the same projections: poses as told, and poses corrected (`rate_pose`: first and last step size).

short = dict(iterations=300, n_points=3000)
fits = {
    'poses as told': lm.fit(data, 'fast', **short),
    'poses corrected': lm.fit(data, 'fast', **short, rate_pose=(4e-3, 4e-4)),
}

fig, axes = plt.subplots(1, 3, figsize=(10, 3.8), layout='constrained')
volumes = {'truth': foot.data, **{name: result.volume() for name, result in fits.items()}}
for axis, (name, volume) in zip(axes, volumes.items()):
    shown = axis.imshow(volume[32].T, origin='lower', cmap='gray', vmin=0, vmax=foot.data.max())
    title = name if name == 'truth' else f'{name}\n{fits[name].metrics()["psnr_3d"]:.1f} dB'
    axis.set(title=title, xticks=[], yticks=[])
fig.colorbar(shown, ax=axes, label='density [1/mm]')

# %%
# The misfit in the measured views says so without the truth. Rendered by default are the views of `result.geometry`, which
# holds the poses as the fit has corrected them.

for name, result in fits.items():
    rms = np.sqrt(np.mean((result.render() - measured) ** 2))
    print(f'{name:16s} rms misfit of line integrals {rms:.3f}')
