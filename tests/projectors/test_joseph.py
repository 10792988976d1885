"""Joseph's projector against a literal transcription, its transpose, and the analytic ball."""

import mitsuba as mi
import numpy as np
import pytest

from helpers.grids import scan
from helpers.matrices import assert_kernels_serve_any_views, assert_pair, device_images, matrix
from helpers.motions import climbing, posed, reversed_panel, shaken, turned
from helpers.short import short
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.projectors.stack import Stack

POSED = {
    **{motion.__name__: posed(motion) for motion in (climbing, shaken, turned, reversed_panel)},
    **{f'{motion.__name__} parallel': posed(motion, 'parallel') for motion in (climbing, shaken, turned)},
}
CHANGES = {
    'cone': dict(),
    'parallel': dict(mode='parallel'),
    'one slice': dict(nVoxel=(9, 11, 1)),
    'one sheet': dict(mode='parallel', nVoxel=(1, 8, 7)),
    'one row': dict(nDetector=(1, 21)),
    'panel at the axis': dict(DSO=400.0, DSD=400.0),
    'wide pixels': dict(dDetector=(9.0, 8.0)),
    'narrow pixels': dict(dDetector=(1.0, 1.1)),
}
SHORT = (
    'cone',
    'parallel',
    'one slice',
    'one sheet',
    'one row',
    'wide pixels',
    'shaken',
    'reversed_panel',
    'climbing parallel',
)


@pytest.mark.parametrize(
    'geometry', short({name: scan(n=3, **changes) for name, changes in CHANGES.items()} | POSED, SHORT)
)
def test_against_the_transcription(geometry):
    dense = matrix(geometry)
    for masked in (False, True):
        assert_pair(Joseph, geometry, dense, masked)


@pytest.mark.parametrize('changes', [*CHANGES.values(), dict(offOrigin=(0.0, 0.0, 0.0), offDetector=(0.0, 0.0), n=8)])
def test_transpose(changes):
    geometry = scan(**changes)
    J, rng = Joseph(geometry), np.random.default_rng(1)
    n = len(geometry)
    x = rng.normal(size=geometry.grid.shape).astype(np.float32)
    y = rng.normal(size=(n, *geometry.nDetector)).astype(np.float32)
    ax = J.forward(mi.Float(x.ravel()), range(n))[0].numpy().astype(float)
    aty = J.adjoint(device_images(y), range(n)).numpy().astype(float)
    scale = np.linalg.norm(ax) * np.linalg.norm(y)
    assert abs(ax @ y.transpose(0, 2, 1).ravel() - aty @ x.ravel()) < 1e-5 * scale and scale > 0


def test_rays_along_all_faces_of_the_volume_are_alike():
    """Rays on a face, to the last bit, see the voxels beside it, forward and back."""
    geometry = CircularGeometry(
        DSO=8.0, DSD=8.0, nDetector=(6, 5), dDetector=1.0, angles=[0.0], mode='parallel', grid=Grid((3, 4, 5), 1.0)
    )
    J, ones = Joseph(geometry), mi.Float(np.ones(60, np.float32))
    image, path = (a.numpy() for a in J.forward(ones, [0]))
    np.testing.assert_array_equal(image, 3)
    np.testing.assert_array_equal(path, 3)
    back = J.adjoint(mi.Float(np.ones(30, np.float32)), [0]).numpy().reshape(3, 4, 5)
    assert back.sum() == 3 * 30
    np.testing.assert_array_equal(back, back[:, ::-1, ::-1])


def test_voxels_beside_a_ray_add_nothing_whatever_they_hold():
    """If rays pass voxel centres, or half a voxel beyond the outermost, the neighbours have no weight."""
    geometry = CircularGeometry(
        DSO=8.0, DSD=8.0, nDetector=(3, 3), dDetector=1.0, angles=[0.0], mode='parallel', grid=Grid((3, 3, 3), 1.0)
    )
    for i in range(9):
        row, column = i // 3, i % 3
        volume = np.full((3, 3, 3), np.nan, np.float32)
        volume[:, 2 - column, 2 - row] = 1
        image = Joseph(geometry).forward(mi.Float(volume.ravel()), [0])[0].numpy().reshape(3, 3).T
        assert (image == 3).sum() == 1 and np.isnan(image).sum() == 8


@pytest.mark.parametrize(
    'voxels',
    [
        dict(nVoxel=(40, 44, 36), dVoxel=(2.0, 1.8, 2.2)),
        dict(nVoxel=(80, 20, 36), dVoxel=(1.0, 4.0, 2.2)),
        dict(nVoxel=(20, 160, 36), dVoxel=(4.0, 0.5, 2.2)),
    ],
    ids=str,
)
def test_smooth_ball_against_the_exact_projector(voxels):
    """Joseph samples once a slice, which is nearly exact where the volume is smooth, however long the voxels are."""
    geometry = scan(n=6, nDetector=(30, 34), dDetector=(4.0, 4.0), **voxels)
    grid = [
        (np.arange(n) + 0.5 - n / 2) * d + o
        for n, d, o in zip(geometry.grid.shape, geometry.grid.spacing, geometry.grid.centre)
    ]
    x = np.stack(np.meshgrid(*grid, indexing='ij'), -1)
    volume = 0.02 / (1 + np.exp((np.linalg.norm(x - [6.0, -5.0, 4.0], axis=-1) - 25) / 2.0))
    result = Joseph(geometry).forward(mi.Float(np.float32(volume).ravel()), range(6))[0].numpy()
    result = result.reshape(6, 34, 30).transpose(0, 2, 1)
    exact = project_volume(volume, geometry)
    assert np.linalg.norm(result - exact) < 0.004 * np.linalg.norm(exact)


def test_kernels_serve_any_views():
    assert_kernels_serve_any_views(Joseph(scan(n=7)))


def test_scans_it_does_not_serve():
    """In these, the volume reaches beyond the source, or so near that a voxel would cover hundreds of rows, or a panel leans or
    is turned."""
    lean = np.array([0, 1e-3, 0])
    others = [
        scan(DSO=15.0, DSD=300.0),
        scan(DSO=28.35, DSD=300.0, n=90),
        posed(lambda rays, _: dict(v=rays.v + lean)),
        posed(lambda rays, _: dict(u=rays.u + lean[::-1] + [0, 0, 1e-3])),
        posed(lambda rays, _: dict(source=np.array([[0.6, 0, 0.8]] * 3)), 'parallel'),
    ]
    for geometry in others:
        assert not Joseph.serves(geometry)
        with pytest.raises(InputError, match='upright panel'):
            Joseph(geometry)


def test_voxels_that_32_bits_cannot_count():
    with pytest.raises(InputError, match='4294967296 voxels are too many for one volume: lower nVoxel'):
        Stack(scan(nVoxel=(2**16, 2**16, 1)))
