"""Line integrals and voxels of 3D Gaussians as functions of arrays: NumPy, Dr.Jit, PyTorch or JAX, with gradients."""

from lingo_mi.functional.operators import project, voxelize

__all__ = ['project', 'voxelize']
