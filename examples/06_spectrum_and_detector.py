"""
Beam hardening and a real detector
==================================

A scene with an `xray_tube` and a `ct_detector` is seen as a detector would see it. The fit models what the scene names: here a
spectrum of 80 kV, of which soft photons are lost first.
"""

# %%
# The shipped scene `effects/hardening`, at a small size: two materials, a tube of 80 kV, an energy-integrating detector.

import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

data = lm.simulate('effects/hardening', parameters=dict(pixels=64, pixel_size=4, voxels=48, voxel_size=2.6667))
print(data.train.effects)

# %%
# One fit takes the projections for line integrals, as if photons had one energy; the other models the spectrum.

fits = {name: lm.fit(data, 'fast', iterations=250, n_points=3000, effects=name) for name in ('ignore', 'model')}

fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout='constrained')
volumes = {'truth': data.volume, 'effect ignored': fits['ignore'].volume(), 'effect modelled': fits['model'].volume()}
for axis, (title, volume) in zip(axes, volumes.items()):
    middle = volume.shape[2] // 2
    axis.imshow(volume[:, :, middle].T, origin='lower', cmap='gray', vmin=0, vmax=data.volume.max())
    axis.set(title=title, xticks=[], yticks=[])

# %%
# Ignored, the middle of dense parts comes out too thin ("cupping").

for name, result in fits.items():
    error = result.volume() - data.volume
    print(f'{name:7s} rms error of the density {np.sqrt(np.mean(error**2)):.2e} 1/mm')
