"""
Checking derivatives
====================

Derivatives of the splat are exact to float32. This compares them with central differences of the closed form in float64.
"""

# %%
# The function is L = sum(w * image) with fixed random weights w. First its derivatives by Dr.Jit.

import drjit as dr
import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

lm.use_variant()

import mitsuba as mi

rng = np.random.default_rng(0)
count = 6
cloud = [
    rng.normal(0, 10, (count, 3)),  # means, mm
    rng.uniform(2, 6, (count, 3)),  # scales, mm
    rng.normal(size=(count, 4)),  # quaternions, any length
    rng.uniform(0.01, 0.1, count),  # densities
]
geometry = lm.Geometry.cone(DSO=200, DSD=300, nDetector=(64, 64), dDetector=(2, 2), grid=lm.Grid(32, 3), angles=[0.3])
weights = rng.normal(size=(1, 64, 64)).astype(np.float32)
leaves = [mi.TensorXf(x.astype(np.float32)) for x in cloud]
dr.enable_grad(*leaves)
dr.backward(dr.sum(lm.project(*leaves, geometry, extent=8.0) * mi.TensorXf(weights), axis=None))
exact = [dr.grad(x).numpy() for x in leaves]

# %%
# Then by differences of a plain NumPy evaluation in float64: every Gaussian on every ray.

from scipy.spatial.transform import Rotation


def loss(means, scales, quaternions, density):
    """The same function, ray by ray."""
    rays = geometry.rays()
    v, u = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5, indexing='ij')
    start, direction = (x.reshape(-1, 3) for x in rays.through(0, u, v))
    total = np.zeros(len(start))
    for p, s, q, rho in zip(means, scales, quaternions, density):
        whiten = Rotation.from_quat(q).as_matrix().T / s[:, None]
        w, d = (p - start) @ whiten.T, direction @ whiten.T
        dd = (d * d).sum(1)
        off = (np.cross(w, d) ** 2).sum(1) / dd
        total += rho * np.sqrt(2 * np.pi / dd) * np.linalg.norm(direction, axis=1) * np.exp(-off / 2)
    return float(weights.ravel().astype(float) @ total)


errors = {}
for k, name in enumerate(('means', 'scales', 'quaternions', 'density')):
    differences = np.zeros(cloud[k].shape)
    for index in np.ndindex(cloud[k].shape):
        step = 1e-5 * max(abs(cloud[k][index]), 1e-2)
        up, down = [x.copy() for x in cloud], [x.copy() for x in cloud]
        up[k][index] += step
        down[k][index] -= step
        differences[index] = (loss(*up) - loss(*down)) / (2 * step)
    errors[name] = np.linalg.norm(exact[k] - differences) / np.linalg.norm(differences)

# %%
# Relative errors of the four gradients. 6e-8 is the rounding of a float32.

fig, axis = plt.subplots(figsize=(6, 2.4), layout='constrained')
axis.barh(list(errors), list(errors.values()))
axis.set(xscale='log', xlim=(1e-8, 1e-3), xlabel='relative error of the gradient')
print({name: f'{error:.1e}' for name, error in errors.items()})

# %%
# `lingo-mi gradcheck SCENE` does this for any Mitsuba scene.
