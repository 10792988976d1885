"""The operators of clouds and voxels as functions of arrays: NumPy, Dr.Jit, PyTorch or JAX, with gradients."""

from lingo_mi.functional.gaussian_projector import GaussianProjector
from lingo_mi.functional.operators import project, voxelize
from lingo_mi.functional.projector import Projector

__all__ = ['GaussianProjector', 'Projector', 'project', 'voxelize']
