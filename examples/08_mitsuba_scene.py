"""
A Mitsuba scene with a mesh and a cloud
=======================================

The integrator `lingo_xray` is a Mitsuba plugin like any other. It adds up line integrals through Gaussians, grids and closed
meshes. Derivatives by the Gaussians, the grid's values and the mesh's attenuation come through `mi.render`.
"""

# %%
# Import `lingo_mi` before `mi.set_variant`, so that Dr.Jit finds its LLVM.

import drjit as dr
import matplotlib.pyplot as plt
import numpy as np

import lingo_mi as lm

lm.use_variant()

import mitsuba as mi

# %%
# A cloud of 200 Gaussians beside a steel cube, and a scanner with 60 views.

rng = np.random.default_rng(0)
gaussians = np.concatenate(
    [rng.normal(0, 12, (200, 3)), rng.uniform(1, 4, (200, 3)), rng.normal(size=(200, 4))], axis=1
).astype(np.float32)
scene = mi.load_dict(
    {
        'type': 'scene',
        'integrator': {'type': 'lingo_xray'},
        'cloud': {
            'type': 'ellipsoids',
            'data': mi.TensorXf(gaussians),
            'density': mi.TensorXf(np.full((200, 1), 0.02, np.float32)),
        },
        'cube': {
            'type': 'cube',
            'to_world': mi.ScalarTransform4f().translate([25, 0, 0]).rotate([1, 1, 0], 30).scale(6),
            'interior': {'type': 'homogeneous', 'sigma_t': {'type': 'uniform', 'value': 0.05}, 'albedo': 0.0},
            'bsdf': {'type': 'null'},
        },
        'scanner': {
            'type': 'ct_scanner',
            'DSO': 300.0,
            'DSD': 450.0,
            'nDetector': '128',
            'dDetector': '1.2',
            'nVoxel': '64',
            'dVoxel': '1.5',
            'views': 60,
        },
    }
)
scanner = scene.sensors()[0]

# %%
# One view of the scanner is a sensor.

images = {view: mi.render(scene, sensor=scanner.view(view)).numpy()[:, :, 0] for view in (0, 10, 20)}
fig, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout='constrained')
for axis, (view, image) in zip(axes, images.items()):
    shown = axis.imshow(image, cmap='gray', vmin=0, vmax=max(image.max() for image in images.values()))
    axis.set(title=f'view {view}', xticks=[], yticks=[])
fig.colorbar(shown, ax=axes, label='line integral')

# %%
# Derivatives: which Gaussians would change the image inside a small window, if they moved?

params = mi.traverse(scene)
dr.enable_grad(params['cloud.data'])
params.update()
image = mi.render(scene, params, sensor=scanner.view(0))
dr.backward(dr.sum(image[60:68, 60:68], axis=None))
by_data = dr.grad(params['cloud.data']).numpy().reshape(-1, 10)
print('Gaussians that the window sees:', np.count_nonzero(np.abs(by_data[:, :3]).sum(1) > 1e-9))
