"""
The X-ray operator by itself
============================

`lm.Projector` is the matrix A of a scan: `A(volume)` projects, `A.T(projections)` is its transpose, exact to rounding. Both take
arrays of NumPy, Dr.Jit, PyTorch and JAX. This example writes three reconstructions with it: SIRT, least squares by SciPy, and
proximal gradient descent with a denoiser of scikit-image.
"""

# %%
# A scan: 30 views of a chest on 64³ voxels. Any `lm.Geometry` will do, also one of free poses.

import matplotlib.pyplot as plt
import numpy as np
from scipy.sparse.linalg import lsqr
from skimage.restoration import denoise_tv_chambolle

import lingo_mi as lm

chest = lm.phantom('chest', size=64)
geometry = lm.Geometry.cone(
    DSO=1000, DSD=1500, nDetector=(96, 96), dDetector=(9, 9), grid=chest.grid, angles=lm.circular(30, 360)
)
b = lm.simulate(chest, geometry).train.projections
A = lm.Projector(geometry)
print(A)

# %%
# A.T is the transpose, so the two inner products agree.

rng = np.random.default_rng(0)
x, y = rng.random(A.domain_shape, np.float32), rng.random(A.range_shape, np.float32)
print(np.vdot(A(x), y), np.vdot(x, A.T(y)))

# %%
# SIRT.

per_ray = np.maximum(A(np.ones(A.domain_shape)), 1e-3)
per_voxel = np.maximum(A.T(np.ones(A.range_shape)), 1e-3)
sirt = np.zeros(A.domain_shape, np.float32)
for _ in range(50):
    sirt += A.T((b - A(sirt)) / per_ray) / per_voxel
    np.maximum(sirt, 0, out=sirt)

# %%
# The same matrix for SciPy, here with a little damping.

solution = lsqr(A.aslinearoperator(), b.ravel(), damp=0.02 * A.norm(), iter_lim=50)[0]
least_squares = solution.reshape(A.domain_shape)

# %%
# A denoiser after each step of gradient descent, with Nesterov's momentum. Any function may take its place (plug and play).

step = 1 / A.norm() ** 2
plug_and_play = momentum = np.zeros(A.domain_shape, np.float32)
for k in range(20):
    gradient = A.T(A(momentum) - b)
    new = np.maximum(denoise_tv_chambolle(momentum - step * gradient, weight=2e-4, max_num_iter=20), 0)
    momentum = new + k / (k + 3) * (new - plug_and_play)
    plug_and_play = new

# %%
# How good they are.

volumes = {'truth': chest.data, 'SIRT': sirt, 'LSQR': least_squares, 'denoiser': plug_and_play}
figure, axes = plt.subplots(1, 4, figsize=(10, 2.8), layout='constrained')
for ax, (name, volume) in zip(axes, volumes.items()):
    error = np.mean((volume - chest.data) ** 2)
    decibels = '' if name == 'truth' else f'{10 * np.log10(chest.data.max() ** 2 / error):.1f} dB'
    ax.imshow(volume[:, :, 32].T, cmap='gray', vmin=0, vmax=chest.data.max())
    ax.set_title(f'{name} {decibels}', fontsize=9)
    ax.axis('off')
    print(name, decibels)
plt.show()
