"""Shares of voxels inside meshes of triangles."""

import numpy as np
import pytest
import trimesh

from lingo_mi.geometry.triangles import voxelize_triangles

GRID = np.full(3, -2.0), np.full(3, 0.5), (8, 8, 8)


def test_a_mesh_larger_than_the_grid_fills_it():
    box = trimesh.creation.box((20.0, 20.0, 20.0))
    np.testing.assert_allclose(voxelize_triangles(box.triangles, *GRID), 1, atol=1e-6)


@pytest.mark.parametrize('shift', [0.0, 1e-6])
def test_corners_on_and_beside_the_lines_that_are_followed(shift):
    """The lines stand at 1/16, 3/16 ... of a mm: a corner on one of them belongs to the triangles on one side."""
    octahedron = trimesh.Trimesh(
        np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]) + 1 / 16 + shift,
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    )
    assert voxelize_triangles(octahedron.triangles, *GRID).sum() * 0.5**3 == pytest.approx(4 / 3, rel=0.02)


def test_parts_that_overlap_count_twice():
    """The lengths of rays through them count twice, too."""
    one, other = (trimesh.creation.box((2.0, 2.0, 2.0)).triangles + shift for shift in (-0.5, 0.25))
    assert voxelize_triangles(np.concatenate([one, other]), *GRID).max() == pytest.approx(2)
    np.testing.assert_allclose(
        voxelize_triangles(np.concatenate([one, other]), *GRID),
        voxelize_triangles(one, *GRID) + voxelize_triangles(other, *GRID),
    )


def test_a_mesh_over_the_edge_of_the_grid():
    """A box reaches from the middle of the grid to beyond its end, along each axis."""
    for axis in range(3):
        size, middle = np.full(3, 20.0), np.zeros(3)
        size[axis], middle[axis] = 10, 5
        volume = voxelize_triangles(trimesh.creation.box(size).triangles + middle, *GRID)
        expected = np.moveaxis(np.zeros((8, 8, 8)) + (np.arange(8) >= 4)[:, None, None], 0, axis)
        np.testing.assert_allclose(volume, expected, atol=1e-6)
