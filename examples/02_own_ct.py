"""
Your own CT volume
==================

Any volume can be scanned and fitted: a NIfTI, NRRD, MHA, DICOM or NumPy file, or an array. This example makes one with a
voxel size of its own, scans it with a scanner of its own, and writes the fitted volume back as NIfTI.
"""

# %%
# A volume is an array [x, y, z] of densities. This one is a chest of 64 x 64 x 64 voxels of 5.9 mm, attenuation in 1/mm.

import tempfile
from pathlib import Path

import numpy as np

import lingo_mi as lm

# sphinx_gallery_thumbnail_path = 'figures/chest.png'

chest = lm.phantom('chest', size=64)
volume = 0.02 * chest.data
chest

# %%
# The scanner: source 1 m from the axis, panel 1.5 m from the source, 96 x 96 pixels of 7.5 mm.

angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
scanner = dict(DSO=1000, DSD=1500, nDetector=(96, 96), dDetector=(7.5, 7.5))
grid = lm.Grid(volume.shape, chest.spacing)
geometry = lm.Geometry.cone(**scanner, grid=grid, angles=angles)
between = lm.Geometry.cone(**scanner, grid=grid, angles=angles[:4] + np.pi / 20)
data = lm.simulate(volume, geometry, held_out=between)
data

# %%
# The fit, from the 20 views alone. Densities keep their unit. Sliders go through the fitted volume and the held-out views; the
# picture below them has the true slices and the difference. Ribs and vessels of a voxel's width need more than 20 views.

fit = lm.fit(data, 'fast', iterations=250, n_points=4000)
fit

# %%
# `save` writes the volume as NIfTI with its voxel size and position, the Gaussians as PLY, and a report.

folder = fit.save(Path(tempfile.mkdtemp()) / 'chest')
print(*sorted(path.name for path in folder.iterdir()), sep='\n')

# %%
# On the command line, a CT is scanned by the scanner of the scene `chest` and fitted with
#
# .. code-block:: bash
#
#     lingo-mi fit chest --volume my_ct.nii.gz --views 25
