"""
Few views: completion and refinement
====================================

Ten views say little about most voxels. A fitted cloud says what is likely there: iterative algorithms start from its volume,
and `Refined` corrects its errors.
"""

# %%
# Ten views of a foot, and a cloud fitted to them.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

foot = lm.phantom('foot', size=64)
geometry = lm.Geometry.cone(
    DSO=1000,
    DSD=1500,
    nDetector=(128, 128),
    dDetector=(4, 4),
    grid=foot.grid,
    angles=np.linspace(0, np.pi, 10, endpoint=False),
)
data = lm.simulate(foot, geometry)
fit = lm.fit(data, 'fast', iterations=300, n_points=3000)
data

# %%
# Five volumes of the same ten views. `start=fit` hands the cloud's own volume over.

volumes = {
    'FDK': lm.reconstruct(data.train, lm.FDK()),
    'SART': lm.reconstruct(data.train, lm.SART(niter=20)),
    'ASD-POCS': lm.reconstruct(data.train, lm.ASDPOCS(niter=20)),
    'cloud': fit,
    'refined': lm.reconstruct(data.train, lm.Refined(niter=10, completed_niter=0), start=fit),
}

fig, axes = plt.subplots(2, 3, figsize=(9, 6.6), layout='constrained')
shown = {'truth': foot.data}
for name, result in volumes.items():
    numbers = result.metrics() if result is fit else result.metrics(foot.data)
    shown[f'{name}, {numbers["psnr_3d"]:.1f} dB'] = np.asarray(result)
for axis, (title, volume) in zip(axes.flat, shown.items()):
    axis.imshow(volume[32].T, origin='lower', cmap='gray', vmin=0, vmax=foot.data.max())
    axis.set(title=title, xticks=[], yticks=[])

# %%
# A reconstruction is saved as NIfTI, with its voxel size and position.

print(volumes['refined'].save(Path(tempfile.mkdtemp()) / 'refined.nii.gz').name)

# %%
# FDK has streaks. On these clean projections 20 passes of SART or ASD-POCS are about as good as the cloud, and volumes that
# start from the cloud are 3 dB better. The projections were simulated from the voxels themselves, without noise, which favours
# algorithms on voxels. The benchmarks have noise, other objects, and objects finer than the voxels.
