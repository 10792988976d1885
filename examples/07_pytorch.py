"""
In a PyTorch training loop
==========================

`lm.project` is differentiable for PyTorch tensors: the exact X-ray counterpart of a Gaussian rasteriser, without a CUDA
toolkit. This example fits a cloud with `torch.optim.Adam` and nothing else. It needs ``pip install '.[torch]'`` in a checkout.
"""

# %%
# Targets: 12 views of a foot. The rays are exact, for any pose and any size of Gaussian. Tensors and `lm` share a device.

import matplotlib.pyplot as plt
import numpy as np
import torch

import lingo_mi as lm

device = 'cuda' if torch.cuda.is_available() else 'cpu'
lm.use_variant('cuda_ad_mono' if device == 'cuda' else 'llvm_ad_mono')
foot = lm.phantom('foot', size=48)
angles = np.linspace(0, np.pi, 12, endpoint=False)
geometry = lm.Geometry.cone(DSO=1000, DSD=1500, nDetector=(72, 72), dDetector=(8, 8), grid=foot.grid, angles=angles)
target = torch.as_tensor(lm.simulate(foot, geometry).train.projections, device=device)

# %%
# 1500 Gaussians at random places in the middle of the foot's box, as leaves.

rng = torch.Generator().manual_seed(0)
count = 1500
means = ((torch.rand(count, 3, generator=rng) - 0.5) * 200).to(device).requires_grad_()
scales = torch.full((count, 3), np.log(8.0), device=device).requires_grad_()  # logarithms: scales stay positive
quaternions = torch.tensor([[0.0, 0.0, 0.0, 1.0]], device=device).repeat(count, 1).requires_grad_()
density = torch.full((count,), -5.0, device=device).requires_grad_()
optimizer = torch.optim.Adam(
    [{'params': [means], 'lr': 1.0}, {'params': [scales, quaternions], 'lr': 0.02}, {'params': [density], 'lr': 0.1}]
)

# %%
# The loop.

losses = []
for _ in range(120):
    optimizer.zero_grad()
    images = lm.project(means, scales.exp(), quaternions, torch.nn.functional.softplus(density), geometry)
    loss = torch.nn.functional.mse_loss(images, target)
    loss.backward()
    optimizer.step()
    losses.append(loss.item())
print(f'mean squared error {losses[0]:.1f} -> {losses[-1]:.2f}')

# %%
# The volume, by `lm.voxelize`, which is differentiable, too. It is soft: `lm.fit` adds Gaussians where they are missing, and
# starts from a better place.

with torch.no_grad():
    volume = lm.voxelize(means, scales.exp(), quaternions, torch.nn.functional.softplus(density), geometry)
fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout='constrained')
axes[0].semilogy(losses)
axes[0].set(xlabel='step', ylabel='mean squared error')
for axis, image, title in ((axes[1], foot.data, 'truth'), (axes[2], volume.cpu().numpy(), 'cloud')):
    axis.imshow(image[24].T, origin='lower', cmap='gray', vmin=0, vmax=foot.data.max())
    axis.set(title=title, xticks=[], yticks=[])
