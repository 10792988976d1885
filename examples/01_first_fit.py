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
print(data.train.projections.shape, 'to fit,', data.test.projections.shape, 'held out')
data

# %%
# The fit
# -------
# `Fast` is this project's method; `LINGO` and `R2` are the published ones. 600 steps are usual; 250 are enough here.

fit = lm.fit(data, lm.Fast(), iterations=250, n_points=4000)
fit

# %%
# What comes out
# --------------
# A volume on the voxels of the scan, and line integrals in any view. Here is a slice, [y, z] at the middle x, beside the truth.


def compare(truth, result, titles, label, **options):
    """Two images on one scale, and their difference on a tenth of it."""
    fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout='constrained')
    top = truth.max()
    for axis, image, title in zip(axes, (truth, result), titles):
        gray = axis.imshow(image, cmap='gray', vmin=0, vmax=top, **options)
        axis.set(title=title, xticks=[], yticks=[])
    signed = axes[2].imshow(result - truth, cmap='RdBu_r', vmin=-top / 10, vmax=top / 10, **options)
    axes[2].set(title='difference', xticks=[], yticks=[])
    fig.colorbar(gray, ax=axes[:2], label=label)
    fig.colorbar(signed, ax=axes[2], label=label)


compare(data.volume[32].T, fit.volume()[32].T, ('truth', 'fit'), 'density [1/mm]', origin='lower')

# %%
# And a view that the fit has not seen.

rendered = fit.render(data.test.geometry.subset([5]))
compare(data.test.projections[5], rendered[0], ('held-out view', 'rendered'), 'line integral')

# %%
# The numbers: PSNR and SSIM of held-out views and volume. `fit.save('out/foot')` writes all of this to files.

numbers = fit.metrics()
for name in ('psnr_2d', 'ssim_2d', 'psnr_3d', 'ssim_3d', 'gaussians'):
    print(f'{name:10s} {numbers[name]:.4g}')
