"""
Beam hardening and a real detector
==================================

A scene with an `xray_tube` or a `ct_detector` is scanned as a real scanner would see it. The fit models what the scene names:
here a spectrum of 120 kV, whose soft photons are lost first. It needs ``pip install '.[physics]'`` in a checkout.
"""

# %%
# The shipped scene `effects/hardening`, at a small size: an aluminium flange, 120 mm across. Its true density is the
# attenuation at 60 keV, 0.075 per mm.

import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

data = lm.simulate('effects/hardening', parameters=dict(pixels=72, pixel_size=4, voxels=48, voxel_size=160 / 48))
spectrum = data.train.effects.tube.spectrum
print(f'mean energy of the photons {spectrum.mean:.0f} keV')
data

# %%
# One fit takes the projections for line integrals, as if photons had one energy; the other models the spectrum.

fits = {name: lm.fit(data, 'fast', iterations=250, n_points=3000, effects=name) for name in ('ignore', 'model')}

fig, axes = plt.subplots(2, 2, figsize=(8, 7), layout='constrained')
volumes = {'truth': data.volume, 'ignored': fits['ignore'].volume(), 'modelled': fits['model'].volume()}
for axis, (title, volume) in zip(axes.flat, volumes.items()):
    axis.imshow(volume[:, :, 24].T, origin='lower', cmap='gray', vmin=0, vmax=data.volume.max())
    axis.set(title=title, xticks=[], yticks=[])
    axes[1, 1].plot(volume[:, 24, 24], label=title)
axes[1, 1].set(title='middle row', xlabel='x [voxels]', ylabel='density [1/mm]')
axes[1, 1].legend(loc='center right', fontsize='small')

# %%
# If the spectrum is ignored, metal has too low a density, most of all in its middle ("cupping"), and the hole is not empty.

for name, fit in fits.items():
    error = fit.volume() - data.volume
    print(f'{name:7s} rms error of the density {np.sqrt(np.mean(error**2)):.2e} 1/mm')
