"""
A helix with wrong poses
========================

The scanner need not move on a circle. Here it climbs along a helix, and every view is off by about a degree and two
millimetres. The fit does not know this error. It corrects the poses while it fits.
"""

# %%
# The nominal scanner, which the fit uses: two turns that climb 60 mm each.

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import lingo_mi as lm

foot = lm.phantom('foot', size=64)
count = 24
angles = np.linspace(-2 * np.pi, 2 * np.pi, count, endpoint=False)
scanner = dict(DSO=1000, DSD=1500, nDetector=(96, 96), dDetector=(6, 6))
nominal = lm.Geometry.helix(**scanner, grid=foot.grid, angles=angles, pitch=60)
nominal

# %%
# What it really does: every view is turned and shifted a little. The motion that all views share is subtracted, because it is
# the same as a motion of the object, which no projection tells.

rng = np.random.default_rng(1)
turns, shifts = rng.normal(0, 1, (count, 3)), rng.normal(0, 2, (count, 3))  # degrees, mm
turns, shifts = turns - turns.mean(0), shifts - shifts.mean(0)
moved = nominal.rays().moved(Rotation.from_rotvec(np.radians(turns)).as_matrix(), shifts)
real = lm.Geometry.from_poses(moved, nominal.nDetector, grid=foot.grid)
measured = lm.simulate(foot, real)
misled = lm.Dataset(lm.Scan(nominal, measured.train.projections), volume=foot.data)

# %%
# Fits of the same projections with the nominal poses, with these poses corrected (`rate_pose`: first and last step size), and,
# for comparison, with the real ones.

short = dict(iterations=400, n_points=3000)
fits = {
    'nominal': lm.fit(misled, 'fast', **short),
    'corrected': lm.fit(misled, 'fast', **short, rate_pose=(1e-2, 1e-3)),
    'real poses': lm.fit(measured, 'fast', **short),
}

fig, axes = plt.subplots(2, 2, figsize=(8, 7), layout='constrained')
volumes = {'truth': foot.data, **{name: fit.volume() for name, fit in fits.items()}}
for axis, (name, volume) in zip(axes.flat, volumes.items()):
    shown = axis.imshow(volume[32].T, origin='lower', cmap='gray', vmin=0, vmax=foot.data.max())
    title = name if name == 'truth' else f'{name}: {fits[name].metrics()["psnr_3d"]:.1f} dB'
    axis.set(title=title, xticks=[], yticks=[])
fig.colorbar(shown, ax=axes, label='density [1/mm]')

# %%
# Correction wins back more than half of what the wrong poses cost. The misfit in the measured views says so without the truth:
# `fit.render()` renders the views of `fit.geometry`, which holds the poses as the fit has corrected them.

for name, fit in fits.items():
    rms = np.sqrt(np.mean((fit.render() - measured.train.projections) ** 2))
    print(f'{name:10s} rms misfit of line integrals {rms:.3f}')
