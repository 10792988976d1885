"""
An unrolled network in PyTorch
==============================

Some steps of gradient descent, with a small network after each, are a network of their own. It is trained from end to end: the
derivatives pass through `lm.Projector` and its transpose. It needs ``pip install '.[torch]'`` in a checkout.
"""

# %%
# The operator: 8 views of 24³ voxels.

import matplotlib.pyplot as plt
import torch

import lingo_mi as lm

device = 'cuda' if torch.cuda.is_available() else 'cpu'
lm.use_variant('cuda_ad_mono' if device == 'cuda' else 'llvm_ad_mono')
geometry = lm.Geometry.cone(
    DSO=1000, DSD=1500, nDetector=(36, 36), dDetector=(16, 16), nVoxel=24, dVoxel=10, angles=lm.circular(8, 180)
)
A = lm.Projector(geometry)
norm = A.norm()

# %%
# The network. Further axes in front of a volume are its batch.


class Step(torch.nn.Module):
    """A step of gradient descent, whose size is learnt, and a residual convolutional network."""

    def __init__(self, channels=8):
        super().__init__()
        self.size = torch.nn.Parameter(torch.tensor(1.0))
        self.network = torch.nn.Sequential(
            torch.nn.Conv3d(1, channels, 3, padding=1), torch.nn.ReLU(), torch.nn.Conv3d(channels, 1, 3, padding=1)
        )

    def forward(self, x, b):
        """x [batch, x, y, z], b [batch, view, v, u]; both in the units of A / norm(A)"""
        x = x - self.size * A.T(A(x) / norm - b) / norm
        return x + self.network(x[:, None])[:, 0]


class Unrolled(torch.nn.Module):
    def __init__(self, steps=3):
        super().__init__()
        self.steps = torch.nn.ModuleList(Step() for _ in range(steps))

    def forward(self, b):
        x = torch.zeros(len(b), *A.domain_shape, device=b.device)
        for step in self.steps:
            x = step(x, b)
        return x


# %%
# Volumes to learn from: boxes of random places, sizes and densities.


def boxes(count, generator):
    """Volumes [count, x, y, z] of four boxes each."""
    out = torch.zeros(count, *A.domain_shape)
    for volume in out:
        for _ in range(4):
            first = torch.randint(2, 14, (3,), generator=generator)
            last = first + torch.randint(3, 9, (3,), generator=generator)
            volume[tuple(slice(a, b) for a, b in zip(first, last))] += torch.rand((), generator=generator)
    return out.to(device)


# %%
# The training.

generator = torch.Generator().manual_seed(0)
torch.manual_seed(0)
net = Unrolled().to(device)
optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
losses = []
for _ in range(40):
    truth = boxes(2, generator)
    loss = torch.nn.functional.mse_loss(net(A(truth) / norm), truth)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    losses.append(loss.item())

# %%
# A volume that it has not seen, beside as many steps of plain descent.

unseen = boxes(1, generator)
b = A(unseen) / norm
with torch.no_grad():
    learnt, plain = net(b), torch.zeros_like(unseen)
    for _ in net.steps:
        plain = plain - A.T(A(plain) / norm - b) / norm
figure, axes = plt.subplots(1, 4, figsize=(11, 2.8), layout='constrained')
axes[0].semilogy(losses)
axes[0].set(xlabel='step of Adam', ylabel='mean squared error')
for ax, (name, volume) in zip(axes[1:], {'truth': unseen, 'plain descent': plain, 'unrolled network': learnt}.items()):
    error = torch.nn.functional.mse_loss(volume, unseen).item()
    ax.imshow(volume[0, :, :, 12].T.cpu(), cmap='gray', vmin=0, vmax=1.5)
    ax.set_title(f'{name}, error {error:.1e}' if error else name, fontsize=9)
    ax.axis('off')
    print(name, f'{error:.2e}')
plt.show()
