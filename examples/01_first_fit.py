"""
A first fit
===========

Simulate 25 X-ray projections of a foot, fit a cloud of 3D Gaussians to them, and look at the volume and at new views.
"""

# %%
# The scan
# --------
# `phantom` makes a test object, `simulate` scans it: a cone beam, 25 views over half a turn, and 25 others held out.
# Lengths are in mm, angles in radians; projections are line integrals ln(I0 / I), stored [view, v, u].

import matplotlib.pyplot as plt

import lingo_mi as lm

foot = lm.phantom('foot', size=64)
data = lm.simulate(foot, views=25)
print(data.train.projections.shape, data.train.geometry)

# %%
# The fit
# -------
# 'fast' is this project's recipe; 'lingo' and 'r2' are the published ones. 1400 steps are usual, 300 are enough here.

result = lm.fit(data, 'fast', iterations=300, n_points=5000)
print(result)

# %%
# What comes out
# --------------
# A volume on the voxels of the scan, and line integrals in any view. Here is the middle slice beside the truth.

volume = result.volume()
fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout='constrained')
middle = volume.shape[2] // 2
for axis, image, title in zip(axes, (data.volume, volume, volume - data.volume), ('truth', 'fit', 'fit - truth')):
    shown = axis.imshow(image[:, :, middle].T, origin='lower', cmap='RdBu_r' if '-' in title else 'gray')
    if '-' in title:
        shown.set_clim(-0.1, 0.1)
    axis.set(title=title, xticks=[], yticks=[])
    fig.colorbar(shown, ax=axis, shrink=0.8, label='density [1/mm]')

# %%
# And a view that the fit has not seen.

view = result.render(data.test.geometry.subset([5]))[0]
fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout='constrained')
measured = data.test.projections[5]
for axis, image, title in zip(axes, (measured, view, view - measured), ('measured', 'rendered', 'difference')):
    shown = axis.imshow(image, cmap='RdBu_r' if title == 'difference' else 'gray')
    if title == 'difference':
        shown.set_clim(-1, 1)
    axis.set(title=title, xticks=[], yticks=[])
    fig.colorbar(shown, ax=axis, shrink=0.8, label='line integral')

# %%
# The numbers: PSNR and SSIM of held-out views and volume. `result.save('out/foot')` writes all of this to files.

for name in ('psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d', 'gaussians'):
    print(f'{name:10s} {result.metrics()[name]:.4g}')
