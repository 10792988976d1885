"""Grids of voxels, and the two ways in which the constructors of a geometry take them."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.geometry import Geometry, Grid, scanner_rays

GRID = Grid((5, 6, 7), (1.0, 2.0, 3.0), (1, -2, 3))
TIGRE = dict(nVoxel=(5, 6, 7), dVoxel=(1, 2, 3), offOrigin=(1, -2, 3))
PANEL = dict(nDetector=(20, 24), dDetector=(1.5, 2.0))
CONE = dict(DSO=900.0, DSD=1400.0, angles=[0.1, 0.7, 3.0], **PANEL)
RAYS = scanner_rays(CONE['angles'], 900, 1400, **PANEL, tilt=0.1)
ASTRA = dict(
    type='cone', DetectorRowCount=20, DetectorColCount=24, DetectorSpacingX=2.0, DetectorSpacingY=1.5,
    DistanceOriginSource=900, DistanceOriginDetector=500, ProjectionAngles=[0.1, 0.7],
)  # fmt: skip


# ---- the grid ----------------------------------------------------------------------------------------------


def test_numbers_by_hand():
    assert (GRID.shape, GRID.spacing, GRID.centre) == ((5, 6, 7), (1, 2, 3), (1, -2, 3))
    assert GRID.size == (5, 12, 21) and GRID.scale == 2 / 21
    np.testing.assert_array_equal(GRID.low, [-1.5, -8, -7.5])
    np.testing.assert_array_equal(GRID.high, [3.5, 4, 13.5])
    np.testing.assert_array_equal(GRID.first_voxel, [-1, -7, -6])
    np.testing.assert_allclose(GRID.half, [5 / 21, 12 / 21, 1])
    assert {type(x) for x in GRID.shape} == {int} and {type(x) for x in (*GRID.spacing, *GRID.centre)} == {float}


def test_one_number_stands_for_all_three():
    assert Grid(4, 0.5, 1) == Grid((4, 4, 4), (0.5, 0.5, 0.5), (1, 1, 1))
    assert Grid(np.float32(4), [0.5]).centre == (0, 0, 0)


def test_equality_is_by_value():
    same = Grid(np.array([5, 6, 7]), [1, 2, 3], (1.0, -2.0, 3.0))
    assert same == GRID and hash(same) == hash(GRID) and same is not GRID
    for name, value in dict(shape=5, spacing=1.0, centre=0.0).items():
        assert replace(GRID, **{name: value}) != GRID
    with pytest.raises(FrozenInstanceError):
        GRID.shape = (1, 1, 1)


@pytest.mark.parametrize(
    'numbers, match',
    [
        (dict(shape=(1, 2)), r'shape must be 3 finite numbers, not \(1, 2\)'),
        (dict(shape=(1, 2, 2.5)), 'shape must be whole numbers'),
        (dict(shape=(1, 0, 1)), r'shape must be positive, not \(1, 0, 1\)'),
        (dict(shape=1_000_001), 'shape must be at most 1000000 along an axis'),
        (dict(spacing=(1, -1, 1)), 'spacing must be positive'),
        (dict(spacing=np.inf), 'spacing must be 3 finite numbers'),
        (dict(spacing='wide'), 'spacing must be made of numbers'),
        (dict(spacing=1e-13), 'lengths of a scan must lie between'),
        (dict(centre=(0, 0, np.nan)), 'centre must be 3 finite numbers'),
        (dict(centre=1e13), 'centre must be finite lengths'),
    ],
)
def test_bad_numbers(numbers, match):
    with pytest.raises(InputError, match=match):
        Grid(**dict(shape=4, spacing=1.0) | numbers)


def test_other_voxels_in_the_same_box():
    for other, shape in ((GRID.finer(2), (10, 12, 14)), (GRID.resized((10, 3, 7)), (10, 3, 7))):
        assert other.shape == shape and other.centre == GRID.centre
        np.testing.assert_allclose(other.size, GRID.size)
    assert GRID.finer(1) == GRID and GRID.resized(GRID.shape) == GRID


@pytest.mark.parametrize('thickness, parts', [(3, [(0, 3), (3, 6), (6, 7)]), (7, [(0, 7)]), (99, [(0, 7)])])
def test_slabs_stack_up_to_the_grid(thickness, parts):
    assert GRID.slabs(thickness) == parts
    slabs = [GRID.slab(*part) for part in parts]
    assert [slab.shape for slab in slabs] == [(5, 6, end - begin) for begin, end in parts]
    for (begin, _), slab in zip(parts, slabs):
        np.testing.assert_allclose(slab.first_voxel, GRID.first_voxel + [0, 0, 3 * begin])
    np.testing.assert_allclose(slabs[-1].high, GRID.high)


@pytest.mark.parametrize('part', [(-1, 2), (3, 3), (4, 2), (0, 8)])
def test_slices_that_there_are_not(part):
    with pytest.raises(InputError, match=f'the slices 0 to 7, so none from {part[0]} to {part[1]}'):
        GRID.slab(*part)
    with pytest.raises(InputError, match='thickness of a slab, in slices'):
        GRID.slabs(0)


# ---- the voxels of a scan ----------------------------------------------------------------------------------

DOORS = {
    'cone': lambda **v: Geometry.cone(**CONE, **v),
    'parallel': lambda **v: Geometry.parallel(angles=CONE['angles'], **PANEL, **v),
    'helix': lambda **v: Geometry.helix(**CONE, pitch=10.0, **v),
    'tilted': lambda **v: Geometry.cone(**CONE, tilt=0.1, **v),
    'per_view': lambda **v: Geometry.per_view(**CONE, COR=[1.0, 2.0, 3.0], **v),
    'from_poses': lambda **v: Geometry.from_poses(RAYS, PANEL['nDetector'], **v),
    'from_astra': lambda **v: Geometry.from_astra(ASTRA, **v),
}


@pytest.mark.parametrize('make', DOORS.values(), ids=DOORS)
def test_a_grid_or_its_numbers(make):
    one, other = make(grid=GRID), make(**TIGRE)
    assert one.grid is GRID and other.grid == GRID and type(one) is type(other)
    np.testing.assert_array_equal(one.rays().corner, other.rays().corner)
    assert make(nVoxel=4, dVoxel=1.0).grid == Grid(4, 1.0)


@pytest.mark.parametrize('make', DOORS.values(), ids=DOORS)
@pytest.mark.parametrize(
    'voxels', [{}, dict(nVoxel=4), dict(dVoxel=1.0), dict(offOrigin=0), dict(grid=GRID, nVoxel=4, dVoxel=1.0),
               dict(grid=GRID, offOrigin=(1, 2, 3))],
)  # fmt: skip
def test_neither_or_both(make, voxels):
    with pytest.raises(InputError, match='needs its voxels'):
        make(**voxels)


@pytest.mark.parametrize('make', DOORS.values(), ids=DOORS)
@pytest.mark.parametrize(
    'change, match',
    [
        (dict(nVoxel=0), 'nVoxel must be positive'),
        (dict(dVoxel=-1), 'dVoxel must be positive'),
        (dict(offOrigin=np.nan), 'offOrigin must be'),
    ],
)
def test_errors_name_what_was_given(make, change, match):
    with pytest.raises(InputError, match=match):
        make(**TIGRE | change)
    with pytest.raises(InputError, match=r'grid must be a Grid, not tuple; give Grid\(shape, spacing\)'):
        make(grid=(4, 4, 4))


@pytest.mark.parametrize('make', DOORS.values(), ids=DOORS)
def test_other_voxels_keep_the_rays(make):
    g = make(grid=GRID)
    for other in (g.on(Grid(4, 2.0)), replace(g, grid=Grid(4, 2.0))):
        assert other.grid == Grid(4, 2.0) and type(other) is type(g)
        np.testing.assert_array_equal(other.rays().source, g.rays().source)
    with pytest.raises(InputError, match='grid must be a Grid'):
        g.on(4)
    with pytest.raises(InputError, match='lengths of a scan must lie between'):
        g.on(Grid(4, 1e-12))  # too small for this panel
