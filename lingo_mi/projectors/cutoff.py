"""Cut-offs of Gaussians in standard deviations, by purpose. Their errors are in docs/accuracy.md."""

from __future__ import annotations

# Presets of the integrator `lingo_xray`, by name.
PRESETS = {'draft': 3.0, 'default': 5.0, 'reference': 7.0}

# Images and voxels to view or to differentiate: the error of images is 2e-6, of derivatives up to 4e-5 (relative L2 norms).
RENDER = PRESETS['default']

# Fits: R2-Gaussian's (Zha et al., NeurIPS 2024). Larger ones (up to 5) hardly improve a fit; more steps use the time better.
FIT = 3.0

# Simulated measurements, the reference for fits: the error must be below float32's rounding.
SIMULATE = 8.0

# Densities sampled at voxels, as a reference: the error is 2e-8 of the centre's density, below float32's rounding.
SAMPLE = 6.0

# Boxes around clouds: 0.02 % of a Gaussian's mass lies outside.
BOX = 4.0
