"""Cut-offs of Gaussians in standard deviations: one for each purpose. What each costs is in docs/accuracy.md."""

from __future__ import annotations

# Presets of the integrator `lingo_xray`, by name.
PRESETS = {'draft': 3.0, 'default': 5.0, 'reference': 7.0}

# Images and voxels to look at or to differentiate: images are off by 2e-6, derivatives by up to 4e-5 (relative L2 norms).
RENDER = PRESETS['default']

# Fits: R2-Gaussian's (Zha et al., NeurIPS 2024). Up to 5 the quality is about the same, and the time is better spent on steps.
FIT = 3.0

# Measurements that are simulated: what is left out must be less than float32's rounding, since fits are compared with them.
SIMULATE = 8.0

# Densities sampled at voxels, as a truth to compare with: off by 2e-8 of the centre's, which float32 does not hold.
SAMPLE = 6.0

# Boxes around clouds: 0.02 % of a Gaussian's mass lies outside.
BOX = 4.0
