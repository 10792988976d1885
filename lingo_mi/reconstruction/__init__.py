"""Volumes on voxels: filtered backprojection, iterative algorithms, and the refinement of a cloud's volume."""
