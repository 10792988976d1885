"""The constructors of `Geometry`: against `scanner_rays`, numbers by hand, and other packages' own formulas."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.poses import to_matrices
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Geometry, Grid, PosedGeometry, astra, rtk
from lingo_mi.geometry.matrices import from_matrices
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import circular, helix, scanner_rays

PANEL = dict(nDetector=(20, 24), dDetector=(1.5, 2.0))
GRID = dict(nVoxel=(5, 6, 7), dVoxel=(1.0, 2.0, 3.0))
ANGLES = np.array([0.1, 0.7, 3.0])
CONE = dict(DSO=900.0, DSD=1400.0, angles=ANGLES, **PANEL, **GRID)
PARALLEL = dict(angles=ANGLES, **PANEL, **GRID)
MOTION = dict(offDetector=(4.0, -5.0), rotDetector=(0.05, -0.04, 0.1), COR=2.0, tilt=0.03)


def same_rays(a: Rays, b: Rays, tolerance=1e-9):
    assert a.parallel == b.parallel
    for x, y in ((a.source, b.source), (a.corner, b.corner), (a.u, b.u), (a.v, b.v)):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance)


def same_grid(a: Geometry, b: Geometry):
    assert (a.mode, a.nDetector) == (b.mode, b.nDetector)
    for x, y in ((a.grid.shape, b.grid.shape), (a.grid.spacing, b.grid.spacing), (a.grid.centre, b.grid.centre)):
        np.testing.assert_array_equal(x, y)


def scanner(parallel=False, **motion):
    far = (0.0, 0.0) if parallel else (900.0, 1400.0)
    return scanner_rays(ANGLES, *far, PANEL['nDetector'], PANEL['dDetector'], parallel, **motion)


# ---- the front door ----------------------------------------------------------------------------------------


def test_the_base_is_abstract():
    with pytest.raises(TypeError, match='abstract'):
        Geometry(**CONE, mode='cone')


@pytest.mark.parametrize('make', [Geometry.cone, Geometry.parallel])
def test_circles(make):
    numbers = CONE if make == Geometry.cone else PARALLEL
    parallel = make == Geometry.parallel
    g = make(**numbers, offDetector=(4.0, -5.0), offOrigin=(1.0, -2.0, 3.0))
    assert isinstance(g, CircularGeometry) and g.mode == ('parallel' if parallel else 'cone')
    assert (g.grid.centre, g.offDetector) == ((1, -2, 3), (4, -5))
    same_rays(g.rays(), scanner(parallel, offDetector=(4.0, -5.0)), 0)


@pytest.mark.parametrize('angles', [np.arange(25) * 14.4, np.arange(36) * 10, np.arange(720) / 2])
def test_angles_in_degrees(angles):
    """Degrees are noticed, whole numbers or not; the many turns of a helix are not taken for degrees."""
    numbers = CONE | dict(angles=angles)
    with pytest.warns(UserWarning, match=r'turns.* give numpy.radians\(angles\)'):
        Geometry.cone(**numbers)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        Geometry.cone(**numbers | dict(angles=np.radians(angles)))
        Geometry.helix(**numbers | dict(angles=np.linspace(0, 60, 500)), pitch=1.0)


def test_one_number_stands_for_all():
    g = Geometry.cone(
        DSO=9, DSD=14, nDetector=8, dDetector=2, nVoxel=4, dVoxel=0.5, angles=0.3, offOrigin=1, offDetector=2
    )
    assert (
        g.nDetector == (8, 8) and g.dDetector == (2, 2) and g.grid.shape == (4, 4, 4) and g.grid.spacing == (0.5,) * 3
    )
    assert g.grid.centre == (1, 1, 1) and g.offDetector == (2, 2) and len(g) == 1
    assert g.sDetector == (16, 16) and g.grid.size == (2, 2, 2) and g.grid.scale == 1
    turned = Geometry.cone(**CONE, rotDetector=0.1)
    same_rays(turned.rays(), scanner(rotDetector=(0.1, 0.1, 0.1)))


@pytest.mark.parametrize('name', MOTION)
def test_motion(name):
    """Each motion is tested alone, without the others; only an offset keeps the circle."""
    g = Geometry.cone(**CONE, **{name: MOTION[name]})
    assert isinstance(g, CircularGeometry) == (name == 'offDetector')
    same_rays(g.rays(), scanner(**{name: MOTION[name]}))


def test_all_motion_at_once():
    same_rays(Geometry.cone(**CONE, **MOTION).rays(), scanner(**MOTION))
    g = Geometry.parallel(**PARALLEL, **MOTION | dict(rotDetector=(0, 0, 0.1)))
    same_rays(g.rays(), scanner(True, **MOTION | dict(rotDetector=(0, 0, 0.1))))
    g = Geometry.helix(**CONE, **MOTION, pitch=30.0)
    same_rays(g.rays(), scanner(**MOTION, height=helix(ANGLES, 30.0)))


def test_helix_by_hand():
    turns = circular(8, total=720, start=-360)
    g = Geometry.helix(**CONE | dict(angles=turns), pitch=40.0)
    assert isinstance(g, PosedGeometry) and len(g) == 8
    np.testing.assert_allclose(g.rays().source[:, 2], [-40, -30, -20, -10, 0, 10, 20, 30], atol=1e-12)
    np.testing.assert_allclose(g.rays().source[5], [0, 900, 10], atol=1e-9)
    np.testing.assert_allclose(g.rays().centre(g.nDetector)[5], [0, -500, 10], atol=1e-9)
    assert isinstance(Geometry.helix(**CONE, pitch=0.0), CircularGeometry)
    moved = Geometry.helix(**CONE | dict(angles=turns), pitch=40.0, height=5.0)
    np.testing.assert_allclose(moved.rays().source[:, 2] - g.rays().source[:, 2], 5, atol=1e-12)


def test_poses_choose_their_kind():
    circle = Geometry.from_poses(scanner(offDetector=(4.0, -5.0)), PANEL['nDetector'], **GRID, offOrigin=(1, 2, 3))
    assert isinstance(circle, CircularGeometry) and circle.grid.centre == (1, 2, 3)
    np.testing.assert_allclose([circle.DSO, circle.DSD, *circle.offDetector], [900, 1400, 4, -5])
    posed = Geometry.from_poses(scanner(tilt=0.1), PANEL['nDetector'], **GRID)
    assert isinstance(posed, PosedGeometry)
    np.testing.assert_allclose([posed.DSO, posed.DSD, *posed.dDetector], [900, 1400, 1.5, 2.0])
    np.testing.assert_allclose(posed.angles, ANGLES)


@pytest.mark.parametrize('rays', [scanner().vectors, scanner().vectors.tolist()], ids=['array', 'list'])
def test_poses_are_rays(rays):
    with pytest.raises(InputError, match=r'rays must be a Rays, not (ndarray|list); .*Rays.from_vectors'):
        Geometry.from_poses(rays, PANEL['nDetector'], **GRID)


@pytest.mark.parametrize(
    'make, change, match',
    [
        (Geometry.cone, dict(DSO=1500), 'DSD >= DSO > 0'),
        (Geometry.cone, dict(DSO=[900, 901, 902]), 'DSO must be one number'),
        (Geometry.cone, dict(rotDetector=(0.1, 0.2)), 'rotDetector must be 3'),
        (Geometry.cone, dict(nVoxel=(1, 2)), 'nVoxel must be 3'),
        (Geometry.cone, dict(dDetector=0), 'dDetector must be positive'),
        (Geometry.cone, dict(angles=[]), 'at least one angle'),
        (Geometry.cone, dict(tilt=np.nan), 'tilt must be finite numbers, at most .* radians, not nan'),
        (Geometry.parallel, dict(offDetector=(1, 2, 3)), 'offDetector must be 2'),
        (Geometry.cone, dict(COR='far'), 'COR must be made of numbers'),
        (Geometry.cone, dict(height=[1, 2]), 'each of 3 views'),
        (Geometry.helix, dict(pitch=np.nan), 'pitch must be one finite number'),
        (Geometry.helix, dict(pitch='steep'), 'pitch must be made of numbers'),
        (Geometry.per_view, dict(DSO='far'), 'DSO must be made of numbers'),
        (Geometry.per_view, dict(angles='all'), 'angles must be made of numbers'),
    ],
)
def test_bad_numbers(make, change, match):
    numbers = dict(parallel=PARALLEL, helix=CONE | dict(pitch=1.0)).get(make.__name__, CONE)
    with pytest.raises(InputError, match=match):
        make(**numbers | change)


@pytest.mark.parametrize('make', [Geometry.cone, Geometry.per_view])
def test_unknown_names_are_refused(make):
    with pytest.raises(TypeError, match='height_of_source'):
        make(**CONE, height_of_source=1.0)


# ---- what both kinds do ------------------------------------------------------------------------------------


@pytest.mark.parametrize('tilt', [0.0, 0.1])
def test_methods_of_both_kinds(tilt):
    g = Geometry.cone(**CONE, tilt=tilt, offDetector=(4.0, -5.0), offOrigin=(1.0, -2.0, 3.0))
    kind, f = type(g), g.rays()
    assert kind == (PosedGeometry if tilt else CircularGeometry)
    some = g.subset([2, 0])
    assert type(some) is kind and len(some) == 2
    same_rays(some.rays(), f[[2, 0]])
    both = some.joined(g)
    assert type(both) is kind and len(both) == 5
    same_rays(both.rays(), f[[2, 0, 0, 1, 2]])
    finer = g.on(Grid((10, 12, 14), 0.5, g.grid.centre))
    assert type(finer) is kind and finer.grid.shape == (10, 12, 14) and finer.grid.spacing == (0.5,) * 3
    same_rays(finer.rays(), f, 0)
    n = g.normalised_rays()
    np.testing.assert_allclose(n.source, (f.source - (1, -2, 3)) * 2 / 21)
    assert g.grid.half.max() == 1


@pytest.mark.parametrize('tilt', [0.0, 0.1])
def test_binned_rays(tilt):
    g = Geometry.cone(**CONE | dict(nDetector=(3, 23)), tilt=tilt, offDetector=(4.0, -5.0))
    coarse, f = g.binned(4), g.rays()
    assert g.bins(4) == (1, 4) and coarse.nDetector == (3, 5) and type(coarse) is type(g)
    np.testing.assert_allclose(coarse.dDetector, (1.5, 8.0))
    same_rays(coarse.rays(), Rays(f.source, f.corner, 4 * f.u, f.v, False))
    same_rays(g.binned(1).rays(), f, 1e-12)
    assert [g.bins(n) for n in (11, 12)] == [(1, 11), (1, 1)]  # two new pixels at least
    assert Geometry.cone(**CONE | dict(nDetector=(8, 7))).bins(4) == (4, 1)
    with pytest.raises(InputError, match='from 1 on'):
        g.binned(0)


def test_views_of_other_scanners_keep_their_rays():
    g = Geometry.cone(DSO=300, DSD=450, nDetector=9, dDetector=4, nVoxel=8, dVoxel=1, angles=[0.0, 1.0])
    for change in (dict(DSO=310.0), dict(DSD=500.0), dict(dDetector=(4.0, 5.0)), dict(offDetector=(0.0, 2.0))):
        other = replace(g, **change)
        same_rays(g.joined(other).rays(), g.rays().joined(other.rays()))
    with pytest.raises(InputError, match='cone'):
        g.joined(replace(g, mode='parallel'))
    with pytest.raises(InputError, match='panels must agree'):
        g.joined(replace(g, nDetector=(9, 8)))


def test_kinds_join():
    circle, posed = Geometry.cone(**CONE), Geometry.cone(**CONE, tilt=0.1)
    for a, b in ((circle, posed), (posed, circle)):
        both = a.joined(b)
        assert isinstance(both, PosedGeometry)
        same_rays(both.rays(), a.rays().joined(b.rays()))


# ---- TIGRE -------------------------------------------------------------------------------------------------


def tigre(**changes):
    """A geometry with TIGRE's names and order, as `tigre.geometry` has them."""
    values = dict(
        DSO=900.0,
        DSD=1400.0,
        nDetector=np.array([20, 24]),
        dDetector=np.array([1.5, 2.0]),
        sDetector=np.array([30.0, 48.0]),
        nVoxel=np.array([7, 6, 5]),
        dVoxel=np.array([3.0, 2.0, 1.0]),
        sVoxel=np.array([21.0, 12.0, 5.0]),
        accuracy=0.5,
        mode=None,
    )
    return SimpleNamespace(**values | changes)


def test_tigre_circle():
    g = Geometry.from_tigre(tigre(offOrigin=np.array([3, -2, 1]), offDetector=np.array([4, -5])), ANGLES)
    assert isinstance(g, CircularGeometry)
    same_grid(g, Geometry.cone(**CONE, offOrigin=(1, -2, 3)))
    same_rays(g.rays(), scanner(offDetector=(4.0, -5.0)), 0)
    # TIGRE's own formulas for its first pixel: at the angle 0 the source is on x, u along y; its lowest row comes first, so
    # that here it is the last.
    f = Geometry.from_tigre(tigre(offDetector=np.array([4, -5])), [0.0]).rays()
    np.testing.assert_allclose(f.source[0], [900, 0, 0])
    lowest = f.corner[0] + 0.5 * f.u[0] + 19.5 * f.v[0]
    np.testing.assert_allclose(lowest, [-(1400 - 900), 2.0 * (0 - 12 + 0.5) - 5, 1.5 * (0 - 10 + 0.5) + 4])


def test_tigre_repeats_its_numbers():
    """The numbers of `check_geo` agree: it repeats each number for every view, and adds two zeros to angles."""
    n = len(ANGLES)
    geo = tigre(
        DSO=np.full(n, 900.0),
        DSD=np.full(n, 1400.0),
        offOrigin=np.tile([3.0, -2.0, 1.0], (n, 1)),
        offDetector=np.tile([4.0, -5.0], (n, 1)),
        rotDetector=np.zeros((n, 3)),
        COR=np.zeros(n),
        mode='cone',
    )
    g = Geometry.from_tigre(vars(geo), np.stack([ANGLES, 0 * ANGLES, 0 * ANGLES], 1))
    assert isinstance(g, CircularGeometry) and (g.DSO, g.DSD, g.grid.centre) == (900, 1400, (1, -2, 3))
    same_rays(g.rays(), scanner(offDetector=(4.0, -5.0)), 0)


def test_tigre_motion():
    # rotDetector is about (x, y, z) there, (roll, pitch, yaw) about (z, y, x) here.
    geo = tigre(rotDetector=np.array([0.1, -0.04, 0.05]), COR=2.0, DSO=np.array([900.0, 905.0, 910.0]))
    g = Geometry.from_tigre(geo, ANGLES)
    expected = scanner_rays(
        ANGLES, [900, 905, 910], 1400, PANEL['nDetector'], PANEL['dDetector'], rotDetector=(0.05, -0.04, 0.1), COR=2.0
    )
    same_rays(g.rays(), expected)
    # An in-plane turn about the beam, x at the angle 0: columns leave y towards +z.
    f = Geometry.from_tigre(tigre(rotDetector=np.array([0.1, 0, 0])), [0.0]).rays()
    np.testing.assert_allclose(f.u[0], 2 * np.array([0, np.cos(0.1), np.sin(0.1)]), atol=1e-12)
    euler = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]])
    g = Geometry.from_tigre(tigre(), euler)
    same_rays(g.rays(), scanner_rays(euler, 900, 1400, PANEL['nDetector'], PANEL['dDetector']))


def test_tigre_moves_the_object():
    """With an offOrigin for each view, the object at its place there is seen as TIGRE sees it."""
    moves = np.array([[3.0, -2.0, 1.0], [0.0, 4.0, 2.0], [-1.0, 0.0, 5.0]])  # (z, y, x)
    g = Geometry.from_tigre(tigre(offOrigin=moves), ANGLES)
    np.testing.assert_allclose(g.grid.centre, moves.mean(0)[::-1])
    point = np.array([2.0, -1.0, 3.0])
    for view in range(3):
        here = g.rays().project([point + g.grid.centre], view)
        there = scanner().project([point + moves[view, ::-1]], view)
        np.testing.assert_allclose(here, there, atol=1e-9)


@pytest.mark.parametrize('pixel', [1e-6, 1.0, 1e6])
def test_matrices_of_a_parallel_beam_with_pixels_of_any_size(pixel):
    rays = Geometry.parallel(**PARALLEL | dict(dDetector=pixel)).rays()
    shape = (6, 8)
    again = from_matrices(to_matrices(rays), shape, (pixel, pixel), True)
    for name in ('source', 'u', 'v'):
        np.testing.assert_allclose(getattr(again, name), getattr(rays, name), rtol=1e-9, atol=1e-9 * pixel)
    with pytest.raises(InputError, match='^towards must be made of numbers'):
        from_matrices(to_matrices(rays), shape, (pixel, pixel), True, towards='x')
    bad = to_matrices(rays)
    bad[:, 1] = bad[:, 0]
    with pytest.raises(InputError, match='columns and rows along one direction'):
        from_matrices(bad, shape, (pixel, pixel), True)


def test_tigre_parallel_and_sizes():
    geo = tigre(mode='parallel', dDetector=None, dVoxel=None, DSO=None, DSD=None)
    g = Geometry.from_tigre(geo, ANGLES)
    same_grid(g, Geometry.parallel(**PARALLEL))
    same_rays(g.rays(), scanner(True))
    assert g.dDetector == (1.5, 2.0)


@pytest.mark.parametrize(
    'change, match',
    [
        (dict(DSO=None), 'has no DSO'),
        (dict(nVoxel=None), 'has no nVoxel'),
        (dict(offOrigin=np.zeros((2, 3))), 'offOrigin of the TIGRE geometry must be 3 numbers, or that for each of 3'),
        (dict(DSO=2000.0), 'DSD >= DSO > 0'),
        (dict(mode='fan'), 'mode must be'),
    ],
)
def test_bad_tigre(change, match):
    with pytest.raises(InputError, match=match):
        Geometry.from_tigre(tigre(**change), ANGLES)


# ---- ASTRA -------------------------------------------------------------------------------------------------


VOLUME = dict(
    GridColCount=5,
    GridRowCount=6,
    GridSliceCount=7,
    option=dict(WindowMinX=-1.5, WindowMaxX=3.5, WindowMinY=-8.0, WindowMaxY=4.0, WindowMinZ=-7.5, WindowMaxZ=13.5),
)
SPACING = dict(DetectorSpacingX=2.0, DetectorSpacingY=1.5, DetectorRowCount=20, DetectorColCount=24)
PLAIN = {
    'cone': dict(type='cone', **SPACING, ProjectionAngles=ANGLES, DistanceOriginSource=900, DistanceOriginDetector=500),
    'parallel3d': dict(type='parallel3d', **SPACING, ProjectionAngles=ANGLES),
}


def geom_2vec(proj_geom):
    """Return the vectors that the documentation of `astra.functions.geom_2vec` gives for both types."""
    rows = []
    for a in proj_geom['ProjectionAngles']:
        s, c = np.sin(a), np.cos(a)
        if proj_geom['type'] == 'cone':
            rows.append([900 * s, -900 * c, 0, -500 * s, 500 * c, 0, 2 * c, 2 * s, 0, 0, 0, 1.5])
        else:
            rows.append([s, -c, 0, 0, 0, 0, 2 * c, 2 * s, 0, 0, 0, 1.5])
    return dict(type=proj_geom['type'] + '_vec', DetectorRowCount=20, DetectorColCount=24, Vectors=np.array(rows))


@pytest.mark.parametrize('kind', PLAIN)
def test_astra_circles(kind):
    g = Geometry.from_astra(PLAIN[kind], VOLUME)
    assert isinstance(g, CircularGeometry) and g.grid.centre == (1, -2, 3)
    assert (g.grid.shape, g.grid.spacing, g.nDetector, g.dDetector) == ((5, 6, 7), (1, 2, 3), (20, 24), (1.5, 2))
    # The same by its vectors, whose rows are found to be a circle's once they are turned round.
    again = Geometry.from_astra(geom_2vec(PLAIN[kind]), VOLUME)
    assert isinstance(again, CircularGeometry)
    same_grid(again, g)
    same_rays(again.rays(), g.rays())
    # And back: ASTRA's pixel (row, column) is ours (19 - row, column).
    points = np.random.default_rng(0).uniform(-9, 9, (5, 3))
    there = astra.from_vectors(geom_2vec(PLAIN[kind])['Vectors'], (20, 24), kind != 'cone')
    back = astra.to_vectors(g.rays(), g.nDetector) * ([1] * 9 + [-1] * 3)
    np.testing.assert_allclose(np.abs(back), np.abs(geom_2vec(PLAIN[kind])['Vectors']), atol=1e-9)
    for view in range(3):
        (x, y), (column, row) = g.rays().project(points, view), there.project(points, view)
        np.testing.assert_allclose([x, 20 - y], [column, row], atol=1e-9)


@pytest.mark.parametrize('parallel', [False, True])
def test_astra_vectors_both_ways(parallel):
    motion = MOTION | dict(height=[1.0, 5.0, -4.0]) | (dict(rotDetector=(0, 0, 0.1)) if parallel else {})
    f = scanner(parallel, **motion)
    vectors = astra.to_vectors(
        Rays(f.source, f.corner + 20 * f.v, f.u, -f.v, parallel), (20, 24)
    )  # rows up, as ASTRA's
    proj = dict(type='parallel3d_vec' if parallel else 'cone_vec', DetectorRowCount=20, DetectorColCount=24)
    for sign in (1, -1) if parallel else (1,):  # a parallel beam may be given either way
        turned = vectors * ([sign] * 3 + [1] * 9)
        g = Geometry.from_astra(proj | dict(Vectors=turned), **GRID)
        assert isinstance(g, PosedGeometry) and g.grid.shape == (5, 6, 7)
        same_rays(g.rays(), f)


PLANE = dict(
    GridColCount=5, GridRowCount=6, option=dict(WindowMinX=-1.5, WindowMaxX=3.5, WindowMinY=-8.0, WindowMaxY=4.0)
)


@pytest.mark.parametrize('kind', ['fanflat', 'parallel'])
def test_astra_in_two_dimensions(kind):
    """The rays are those of `astra.functions.geom_2vec` for both types, and of its vectors, in the plane z = 0 of the one
    slice."""
    proj = dict(type=kind, DetectorWidth=2.0, DetectorCount=24, ProjectionAngles=ANGLES)
    if kind == 'fanflat':
        proj |= dict(DistanceOriginSource=900, DistanceOriginDetector=500)
    g = Geometry.from_astra(proj, PLANE)
    assert isinstance(g, CircularGeometry) and (g.nDetector, g.dDetector) == ((1, 24), (2, 2))
    assert (g.grid.shape, g.grid.spacing, g.grid.centre) == ((5, 6, 1), (1, 2, 1), (1, -2, 0))
    s, c = np.sin(ANGLES), np.cos(ANGLES)
    far = (900, 500) if kind == 'fanflat' else (1, 0)
    vectors = np.stack([far[0] * s, -far[0] * c, -far[1] * s, far[1] * c, 2 * c, 2 * s], 1)
    np.testing.assert_allclose(
        np.abs(astra.to_vectors(g.rays(), g.nDetector)[:, [0, 1, 3, 4, 6, 7]]), np.abs(vectors), atol=1e-9
    )
    again = Geometry.from_astra(dict(type=kind + '_vec', DetectorCount=24, Vectors=vectors), PLANE)
    assert isinstance(again, CircularGeometry)
    same_rays(again.rays(), g.rays())
    row = g.rays().corner + g.rays().v / 2
    np.testing.assert_allclose(row[:, 2], 0, atol=1e-9)


@pytest.mark.parametrize(
    'proj, more, match',
    [
        (dict(type='sparse_matrix'), dict(vol_geom=VOLUME), "must be of the type cone, .*not 'sparse_matrix'"),
        (dict(type='fanflat', DetectorCount=4), dict(vol_geom=VOLUME), 'has no DetectorWidth'),
        (dict(type='fanflat_vec', DetectorCount=4, Vectors=[[1, 2]]), GRID, '6 numbers for every view'),
        (dict(type='cone'), dict(vol_geom=VOLUME), 'has no Distance'),
        (PLAIN['cone'], {}, 'needs its voxels'),
        (PLAIN['cone'], dict(vol_geom=VOLUME, **GRID), 'needs its voxels'),
        (PLAIN['cone'], dict(nVoxel=4), 'needs its voxels'),
        (PLAIN['cone'], dict(vol_geom=dict(GridRowCount=4, GridColCount=4)), 'has no option'),
        (dict(type='cone_vec', DetectorRowCount=2, DetectorColCount=2, Vectors=[[1, 2]]), GRID, '12 numbers'),
    ],
)
def test_bad_astra(proj, more, match):
    with pytest.raises(InputError, match=match):
        Geometry.from_astra(proj, **more)


# ---- RTK ---------------------------------------------------------------------------------------------------


class Gantry:
    """The methods of RTK's object that are read: its angles are in radians."""

    def __init__(self, n=3, radius=0.0):
        self.n, self.radius = n, radius

    def __getattr__(self, name):
        columns = dict(
            GetSourceToIsocenterDistances=900.0,
            GetSourceToDetectorDistances=1400.0,
            GetGantryAngles=ANGLES[: self.n],
            GetOutOfPlaneAngles=0.0,
            GetInPlaneAngles=0.0,
            GetProjectionOffsetsX=-5.0,
            GetProjectionOffsetsY=4.0,
            GetSourceOffsetsX=0.0,
            GetSourceOffsetsY=0.0,
        )
        return lambda: tuple(np.broadcast_to(columns[name], self.n))

    def GetRadiusCylindricalDetector(self):
        return self.radius


def test_rtk_object_and_file(tmp_path):
    g = Geometry.from_rtk(Gantry(), **PANEL, **GRID, offOrigin=(1, -2, 3))
    assert isinstance(g, CircularGeometry)
    same_grid(g, Geometry.cone(**CONE, offOrigin=(1, -2, 3)))
    same_rays(g.rays(), scanner(offDetector=(4.0, -5.0)))
    f = scanner(**MOTION)
    rtk.write_rtk(tmp_path / 'g.xml', f, PANEL['nDetector'])
    for path in (tmp_path / 'g.xml', str(tmp_path / 'g.xml')):
        again = Geometry.from_rtk(path, **PANEL, **GRID)
        assert isinstance(again, PosedGeometry)
        same_rays(again.rays(), f)


def test_bad_rtk(tmp_path):
    for source, match in (
        (Gantry(radius=-900.0), 'radius must be positive'),
        (Gantry(0), 'holds no projections'),
        (tmp_path / 'gone.xml', 'no such file'),
    ):
        with pytest.raises(InputError, match=match):
            Geometry.from_rtk(source, **PANEL, **GRID)
