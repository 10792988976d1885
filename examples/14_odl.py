"""
The operator in ODL
===================

The Operator Discretization Library (ODL) has convex solvers. `lm.Projector` becomes one of its operators in a dozen lines. It
needs ``pip install odl``.
"""

# %%
# An operator states its domain and range, how it is called, and its adjoint. With weights of 1, the adjoint is the transpose.

import matplotlib.pyplot as plt
import numpy as np
import odl

import lingo_mi as lm


class XRay(odl.Operator):
    def __init__(self, linear_map, domain, range):
        super().__init__(domain, range, linear=True)
        self.linear_map = linear_map

    def _call(self, x):
        return self.linear_map(np.asarray(x.data))

    @property
    def adjoint(self):
        return XRay(self.linear_map.T, self.range, self.domain)


# %%
# A scan of 30 views.

chest = lm.phantom('chest', size=32)
geometry = lm.Geometry.cone(
    DSO=1000, DSD=1500, nDetector=(48, 48), dDetector=(18, 18), grid=chest.grid, angles=lm.circular(30, 360)
)
A = lm.Projector(geometry)
half = np.array(chest.grid.size) / 2
volumes = odl.uniform_discr(-half, half, A.domain_shape, dtype='float32', weighting=1.0)
xray = XRay(A, volumes, odl.tensor_space(A.range_shape, dtype='float32'))
b = xray.range.element(lm.simulate(chest, geometry).train.projections)
print(xray.range.inner(xray(volumes.one()), b), volumes.inner(volumes.one(), xray.adjoint(b)))

# %%
# Least squares, by conjugate gradients of the normal equations.

cgls = volumes.zero()
odl.solvers.conjugate_gradient_normal(xray, cgls, b, niter=15)

# %%
# Total variation and no negative densities, by the primal-dual hybrid gradient (PDHG). Both parts are scaled to norm 1 at most.

norm, steps = A.norm(), odl.Gradient(volumes)
steepest = 2 * np.sqrt(3) / min(chest.grid.spacing)  # its norm is below this
both = odl.BroadcastOperator(xray / norm, steps / steepest)
data = 0.5 * odl.functionals.L2NormSquared(xray.range).translated(b / norm)
variation = 1e-4 * odl.functionals.GroupL1Norm(steps.range)
tau = sigma = 1 / np.sqrt(2)
tv = volumes.zero()
odl.solvers.pdhg(
    tv, odl.functionals.IndicatorNonnegativity(volumes), odl.functionals.SeparableSum(data, variation), both,
    niter=60, tau=tau, sigma=sigma,
)  # fmt: skip

# %%
# How good they are.

figure, axes = plt.subplots(1, 3, figsize=(8, 2.8), layout='constrained')
shown = {'truth': chest.data, 'CGLS': cgls.asarray(), 'TV by PDHG': tv.asarray()}
for ax, (name, volume) in zip(axes, shown.items()):
    error = np.mean((volume - chest.data) ** 2)
    decibels = '' if name == 'truth' else f'{10 * np.log10(chest.data.max() ** 2 / error):.1f} dB'
    ax.imshow(volume[:, :, 16].T, cmap='gray', vmin=0, vmax=chest.data.max())
    ax.set_title(f'{name} {decibels}', fontsize=9)
    ax.axis('off')
    print(name, decibels)
plt.show()
