"""
The operator in deepinv
=======================

deepinv has networks, plug-and-play priors and unrolled algorithms for inverse problems. Its own tomography in 3D needs a GPU.
`lm.Projector` becomes one of its physics in a line. It needs ``pip install deepinv``.
"""

# %%
# A scan of 30 views. deepinv's images are [batch, channel, x, y, z], and the projector takes any axes in front.

import deepinv as dinv
import matplotlib.pyplot as plt
import torch

import lingo_mi as lm

device = 'cuda' if torch.cuda.is_available() else 'cpu'
lm.use_variant('cuda_ad_mono' if device == 'cuda' else 'llvm_ad_mono')
chest = lm.phantom('chest', size=32)
geometry = lm.Geometry.cone(
    DSO=1000, DSD=1500, nDetector=(48, 48), dDetector=(18, 18), grid=chest.grid, angles=lm.circular(30, 360)
)
A = lm.Projector(geometry)
b = torch.as_tensor(lm.simulate(chest, geometry).train.projections, device=device)[None, None]

# %%
# The physics, scaled to a norm of 1 so that steps of 1 are right. deepinv's own test says how well the adjoint fits.

norm = A.norm()
physics = dinv.physics.LinearPhysics(
    A=lambda x, **_: A(x) / norm, A_adjoint=lambda y, **_: A.T(y) / norm, img_size=(1, *A.domain_shape), device=device
)
y = b / norm
error = physics.adjointness_test(img_size=(1, *A.domain_shape), num_samples=10, device=device)
print(f'adjoint: {error:.1e}')

# %%
# Total variation, by accelerated proximal gradient descent. The denoiser's own step, `tau`, is meant for values near 1 by
# default; these are some 0.02 per mm.

fidelity = dinv.optim.data_fidelity.L2()
total_variation = dinv.optim.prior.TVPrior(n_it_max=10)
total_variation.TVModel.tau = 1.0
tv = dinv.optim.FISTA(data_fidelity=fidelity, prior=total_variation, stepsize=1.0, lambda_reg=1e-4, max_iter=40, a=3)
with torch.no_grad():
    smooth = tv(y, physics)

# %%
# Plug and play: plain descent with a denoiser. deepinv's median filter is of images, so the slices are its batch. Trained
# networks take the same place.


class SliceMedian(dinv.models.Denoiser):
    def __init__(self):
        super().__init__()
        self.median = dinv.models.MedianFilter(kernel_size=3)

    def forward(self, x, sigma=None, **_):
        slices = x[:, 0].movedim(3, 1).flatten(0, 1)[:, None]  # [batch z, 1, x, y]
        return self.median(slices).reshape(x.shape[0], x.shape[4], *x.shape[2:4]).movedim(1, 3)[:, None]


pnp = dinv.optim.PGD(data_fidelity=fidelity, prior=dinv.optim.prior.PnP(SliceMedian()), stepsize=1.0, max_iter=40)
with torch.no_grad():
    plug_and_play = pnp(y, physics)

# %%
# How good they are.

figure, axes = plt.subplots(1, 4, figsize=(10, 2.8), layout='constrained')
truth = torch.as_tensor(chest.data, device=device)[None, None]
psnr = dinv.metric.PSNR(max_pixel=float(truth.max()))
with torch.no_grad():
    volumes = {'truth': truth, 'A.T': physics.A_adjoint(y), 'TV': smooth, 'plug and play': plug_and_play}
for ax, (name, volume) in zip(axes, volumes.items()):
    decibels = '' if name == 'truth' else f'{psnr(volume, truth).item():.1f} dB'
    ax.imshow(volume[0, 0, :, :, 16].T.cpu(), cmap='gray', vmin=0, vmax=float(truth.max()))
    ax.set_title(f'{name} {decibels}', fontsize=9)
    ax.axis('off')
    print(name, decibels)
plt.show()
