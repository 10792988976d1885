"""Poses of every kind of scan: equivalences between geometries, axes by hand, bad input."""

import warnings

import numpy as np
import pytest

from helpers import circles
from helpers.bodies import BODIES
from lingo_mi.common.errors import InputError
from lingo_mi.geometry import CircularGeometry, Geometry, PosedGeometry
from lingo_mi.geometry.grid import grid_of
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import circular, helix, rotation, scanner_rays, spread
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Scan

PANEL = dict(nDetector=(24, 30), dDetector=(2.5, 2.0))
GRID = dict(nVoxel=(16, 18, 20), dVoxel=(2.0, 2.2, 1.8))
ANGLES = np.radians([0, 50, 145, 230, 311])
POINTS = np.random.default_rng(0).uniform(-15, 15, (20, 3))


def circle(mode='cone', **changes):
    return circles.circle(**{**dict(DSO=300.0, DSD=450.0, angles=ANGLES, mode=mode), **PANEL, **GRID, **changes})


def moving(**changes):
    return Geometry.per_view(**{**dict(DSO=300.0, DSD=450.0, angles=ANGLES), **PANEL, **GRID, **changes})


def pixels(frames, points=POINTS):
    return np.array([frames.project(points, view) for view in range(len(frames))])


# ---- the circle --------------------------------------------------------------------------------------------


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_circle_by_its_formula(mode):
    g = circle(mode, offDetector=(4.0, -7.0))
    f = g.rays()
    for view, a in enumerate(ANGLES):
        out, u, z = np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0]), np.array([0, 0, 1.0])
        np.testing.assert_allclose(f.source[view], -out if mode == 'parallel' else 300 * out, atol=1e-12)
        np.testing.assert_allclose(f.centre(g.nDetector)[view], -150 * out - 7 * u + 4 * z, atol=1e-12)
        np.testing.assert_allclose([f.u[view], f.v[view]], [2 * u, -2.5 * z], atol=1e-12)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_poses_of_a_circle_are_that_circle(mode):
    g = circle(mode, offDetector=(4.0, -7.0), offOrigin=(1.0, -2.0, 3.0))
    same = Geometry.from_poses(g.rays(), g.nDetector, grid=g.grid)
    assert isinstance(same, CircularGeometry) and same.mode == mode
    np.testing.assert_allclose(same.dDetector, g.dDetector, rtol=1e-14)
    np.testing.assert_allclose(pixels(same.rays()), pixels(g.rays()), atol=1e-10)
    if mode == 'cone':
        np.testing.assert_allclose([same.DSO, same.DSD, *same.offDetector], [300, 450, 4, -7], rtol=1e-12)
    np.testing.assert_allclose(np.mod(same.angles, 2 * np.pi), g.angles, atol=1e-12)


@pytest.mark.parametrize(
    'change',
    [
        dict(height=np.arange(5.0)),
        dict(tilt=0.01),
        dict(rotDetector=(0, 0, 0.01)),
        dict(DSO=300 + 0.1 * np.arange(5)),
        dict(offDetector=0.1 * np.arange(10).reshape(5, 2)),
        dict(COR=np.arange(5.0)),
        dict(offOrigin=np.arange(15.0).reshape(5, 3)),
    ],
)
def test_other_poses_are_kept(change):
    g = moving(**change)
    assert isinstance(g, PosedGeometry) and len(g) == 5 and g.mode == 'cone'
    assert np.abs(pixels(g.rays()) - pixels(circle().rays())).max() > 0.01
    some = g.subset([3, 1])
    np.testing.assert_array_equal(some.rays().corner, g.rays().corner[[3, 1]])
    np.testing.assert_array_equal(some.joined(g).rays().u, g.rays().u[[3, 1, 0, 1, 2, 3, 4]])


@pytest.mark.parametrize(
    'change',
    [
        dict(height=helix(ANGLES, 0.0)),
        dict(tilt=0.0),
        dict(rotDetector=(0.0, 0.0, 0.0)),
        dict(DSO=np.full(5, 300.0)),
        dict(COR=0.0),
    ],
)
def test_no_motion_is_the_circle(change):
    """A helix of pitch 0 and a tilt of 0 are among such motions."""
    g = moving(**change)
    assert isinstance(g, CircularGeometry)
    np.testing.assert_allclose(pixels(g.rays()), pixels(circle().rays()), atol=1e-10)


# ---- equivalences ------------------------------------------------------------------------------------------


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_offset_panel_is_a_shifted_crop(mode):
    from lingo_mi.projectors.grid import project_volume

    volume = np.random.default_rng(1).random(GRID['nVoxel'])
    wide = project_volume(volume, circle(mode, nDetector=(24, 40)))
    # Ten columns fewer on the left, as if the panel were narrower and moved along u by five; two rows up.
    off = project_volume(volume, circle(mode, nDetector=(20, 30), offDetector=(2 * 2.5, 5 * 2.0)))
    np.testing.assert_allclose(off, wide[:, :20, 10:], rtol=2e-5, atol=2e-5 * wide.max())
    # The same, each view with another offset.
    each = project_volume(
        volume,
        Geometry.per_view(
            DSO=300.0,
            DSD=450.0,
            angles=ANGLES,
            mode=mode,
            **GRID,
            nDetector=(24, 30),
            dDetector=PANEL['dDetector'],
            offDetector=np.array([[0.0, 2.0 * k] for k in (-5, 5, 0, 3, -2)]),
        ),
    )
    for view, k in enumerate((-5, 5, 0, 3, -2)):
        np.testing.assert_allclose(each[view], wide[view][:, 5 + k : 35 + k], rtol=2e-5, atol=2e-5 * wide.max())


def test_parallel_views_half_a_turn_apart_mirror_each_other():
    f = circle('parallel', angles=np.radians([33.0, 213.0])).rays()
    here, there = (BODIES.image(f, view, (24, 30)) for view in range(2))
    assert here.max() > 0.1
    np.testing.assert_allclose(there, here[:, ::-1], atol=1e-12)


def test_views_spread_over_a_scan():
    assert spread(100, 4).tolist() == [0, 25, 50, 75] and spread(8, 5).tolist() == [0, 1, 3, 4, 6]
    assert spread(7, 1).tolist() == [0] and spread(3, 3).tolist() == [0, 1, 2]
    for n in (0, 4):
        with pytest.raises(InputError, match=f'{n} views were asked for, but the scan has 3'):
            spread(3, n)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_helix_is_a_sinking_object(mode):
    angles = np.radians([-360.0, -90.0, 0.0, 200.0, 360.0])
    g = moving(angles=angles, height=helix(angles, 12.0), mode=mode)
    still = circle(mode, angles=angles).rays()
    for view, height in enumerate((-12.0, -3.0, 0.0, 12 * 200 / 360, 12.0)):
        image = BODIES.image(g.rays(), view, (24, 30))
        sunk = BODIES.moved(np.eye(3), np.array([0, 0, -height]))
        np.testing.assert_allclose(image, sunk.image(still, view, (24, 30)), atol=1e-10)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_tilted_scan_is_a_turned_object(mode):
    tilt = np.radians(25.0)
    g = moving(tilt=tilt, mode=mode)
    still = circle(mode, angles=[0.0]).rays()
    if mode == 'cone':  # the source is lifted
        np.testing.assert_allclose(g.rays().source[:, 2], 300 * np.sin(tilt))
    for view, a in enumerate(ANGLES):
        turn = rotation('y', tilt)[0] @ rotation('z', -a)[0]  # undoes Rz(a) Ry(-tilt)
        image = BODIES.image(g.rays(), view, (24, 30))
        np.testing.assert_allclose(image, BODIES.moved(turn, np.zeros(3)).image(still, 0, (24, 30)), atol=1e-10)


def test_tigres_euler_angles_and_moving_object():
    euler = np.array([[0.3, 0.2, -0.5], [2.0, -0.4, 0.1]])
    f = scanner_rays(euler, 300.0, 450.0, **PANEL)
    still = circle(angles=[0.0]).rays()
    for view, (a, b, c) in enumerate(euler):
        turn = (rotation('z', a)[0] @ rotation('y', b)[0] @ rotation('z', c)[0]).T
        np.testing.assert_allclose(f.project(POINTS, view), still.project(POINTS @ turn.T, 0), atol=1e-10)
    origin = np.random.default_rng(3).normal(size=(5, 3))
    g = moving(offOrigin=origin)
    np.testing.assert_allclose(g.grid.centre, origin.mean(0))
    for view in range(5):  # the object's points, relative to the centre of the grid, follow offOrigin
        np.testing.assert_allclose(
            g.rays().project(POINTS + g.grid.centre, view),
            circle().rays().project(POINTS + origin[view], view),
            atol=1e-10,
        )


# ---- axes by hand ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'name, turn, u, v',
    [
        ('roll', (90, 0, 0), (-1, 0, 0), (0, 0, -1)),
        ('pitch', (0, 90, 0), (0, 1, 0), (-1, 0, 0)),
        ('yaw', (0, 0, 90), (0, 0, 1), (0, 1, 0)),
    ],
)
def test_panel_turned_a_quarter(name, turn, u, v):
    """At the angle 0 the panel's frame is (towards the source, u, up) = (x, y, z)."""
    f = scanner_rays([0.0], 300.0, 450.0, **PANEL, rotDetector=np.radians(turn), offDetector=(4.0, -7.0))
    np.testing.assert_allclose([f.u[0] / 2, f.v[0] / 2.5], [u, v], atol=1e-12)
    np.testing.assert_allclose(f.centre(PANEL['nDetector'])[0], [-150, -7, 4], atol=1e-10)


def test_shift_of_the_axis():
    f = scanner_rays(np.radians([0.0, 90.0]), 300.0, 450.0, **PANEL, COR=3.0)
    np.testing.assert_allclose(f.source, [[300, 3, 0], [-3, 300, 0]], atol=1e-12)
    np.testing.assert_allclose(f.centre(PANEL['nDetector']), [[-150, 3, 0], [-3, -150, 0]], atol=1e-12)


def plane(one, other, origin):
    """Points [50, 3] of the plane through `origin` that holds two directions."""
    return np.random.default_rng(2).uniform(-20, 20, (50, 2)) @ np.stack([one, other]) + origin


@pytest.mark.parametrize('change, is_line', [({}, True), (dict(angles=[np.radians(-50)]), False)])
def test_oblique_plane_through_the_axis(change, is_line):
    """The plane is one column if it is seen from its own direction, and is not from the opposite angle."""
    x, _ = (
        moving(**{**dict(angles=[np.radians(50)], mode='parallel'), **change})
        .rays()
        .project(plane([np.cos(np.radians(50)), np.sin(np.radians(50)), 0], [0, 0, 1], np.zeros(3)), 0)
    )
    assert (np.ptp(x) < 1e-10) == is_line


@pytest.mark.parametrize(
    'change, row',
    [({}, 12), (dict(tilt=-0.4), None), (dict(height=-6.0), 12 - 12 / 2.5), (dict(angles=[np.radians(-50)]), None)],
)
def test_oblique_plane_of_a_tilted_climbing_beam(change, row):
    """The plane of the beam and u, lifted 6 mm, is the panel's middle row; with any sign turned round it is not."""
    a, tilt = np.radians(50.0), 0.4
    beam = [np.cos(tilt) * np.cos(a), np.cos(tilt) * np.sin(a), np.sin(tilt)]
    g = moving(**{**dict(angles=[a], mode='parallel', tilt=tilt, height=6.0), **change})
    _, y = g.rays().project(plane(beam, [-np.sin(a), np.cos(a), 0], [0, 0, 6.0]), 0)
    if row is None:
        assert np.ptp(y) > 1
    else:  # 12 mm lower along z are 12 cos(tilt) on the panel
        expected = 12 - (12 - row) * np.cos(tilt)
        np.testing.assert_allclose(y, expected, atol=1e-10)


# ---- what uses them ----------------------------------------------------------------------------------------


def test_binned_views_see_the_same():
    g = moving(tilt=0.3, height=np.arange(5.0), nDetector=(25, 30))
    binned = Scan(g, np.ones((5, 25, 30))).binned(2).geometry
    assert binned.nDetector == (12, 15) and binned.dDetector == (5, 4)
    np.testing.assert_allclose(pixels(binned.rays()) * 2, pixels(g.rays()), atol=1e-10)


def test_normalised_frames_of_poses():
    g = moving(tilt=0.3, offOrigin=(4.0, -5.0, 6.0))
    points = (POINTS - g.grid.centre) * g.grid.scale
    np.testing.assert_allclose(pixels(g.normalised_rays(), points), pixels(g.rays()), atol=1e-9)


def test_filtered_backprojection_refuses_other_poses():
    from lingo_mi.reconstruction.fdk import FDK

    g = moving(tilt=0.3)
    with pytest.raises(InputError, match='on a circle about z'):
        run_algorithm(Scan(g, np.ones((5, 24, 30))), FDK())
    scan = Scan(moving(angles=circular(5), tilt=0.0), np.ones((5, 24, 30)))
    assert run_algorithm(scan, FDK()).volume.shape == g.grid.shape


# ---- bad input ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'change, match',
    [
        (dict(DSO=np.ones(4)), 'DSO must be one number, or that for each of 5 views'),
        (dict(offDetector=np.ones((4, 2))), 'offDetector must be 2 numbers'),
        (dict(rotDetector=0.1), 'rotDetector must be 3 numbers'),
        (dict(DSO=[300, 300, 500, 300, 300]), 'DSD >= DSO'),
        (dict(offOrigin=np.ones((4, 3))), 'offOrigin must be'),
        (dict(height=np.full(5, np.nan)), 'height must be finite'),
        (dict(angles=np.ones((5, 2))), 'angles must be'),
        (dict(rotDetector=(np.pi / 2, 0.0, 0.0)), 'source in the plane of its panel'),
        (dict(mode='fan'), 'mode must be'),
        (dict(angles=[]), 'at least one view'),
    ],
)
def test_bad_motion(change, match):
    with pytest.raises(InputError, match=match) as caught:
        moving(**change)
    assert '\n' not in str(caught.value)


def test_bad_poses():
    f = circle().rays()
    bad = {
        'span no panel': dict(v=f.u),
        'all be \\[view, 3\\]': dict(u=f.u[:2]),
        'source in the plane': dict(source=f.corner),
        'NaN': dict(corner=f.corner * np.inf),
    }
    for match, change in bad.items():
        arrays = dict(source=f.source, corner=f.corner, u=f.u, v=f.v) | change
        with pytest.raises(InputError, match=match):
            Geometry.from_poses(Rays(**arrays, parallel=False), **GRID, nDetector=(24, 30))
    p = circle('parallel').rays()
    with pytest.raises(InputError, match='view 0 has a beam along its panel'):
        Geometry.from_poses(Rays(p.u, p.corner, p.u, p.v, True), **GRID, nDetector=(24, 30))
    # Angles and beam cannot contradict the poses: they follow from them.
    few = PosedGeometry(poses=f[:2], grid=grid_of(GRID), nDetector=(24, 30))
    assert len(few) == len(few.angles) == 2 and few.mode == 'cone'
    with pytest.raises(InputError, match='parallel and of a cone'):
        few.joined(circle('parallel'))
    with pytest.raises(InputError, match='one scan'):
        moving(tilt=0.1).joined(circle('parallel'))


@pytest.mark.parametrize('name', ['nDetector', 'nVoxel'])
@pytest.mark.parametrize('count', [24.9, (24, 32.5, 24)])
def test_counts_are_whole_numbers(name, count):
    count = count[:2] if name == 'nDetector' and isinstance(count, tuple) else count
    scan = dict(DSO=100, DSD=150, nDetector=32.0, dDetector=1, nVoxel=np.float32(24), dVoxel=1, angles=[0.0])
    assert Geometry.cone(**scan).grid.shape == (24, 24, 24)
    with pytest.raises(InputError, match=f'{name} must be whole numbers'):
        Geometry.cone(**scan | {name: count})


@pytest.mark.parametrize('name', ['nVoxel', 'dDetector', 'angles', 'offOrigin'])
@pytest.mark.parametrize('value', ['many', ['a', 'b', 'c'], [None, 1, 2]])
def test_what_is_no_number(name, value):
    scan = dict(nDetector=32, dDetector=1, nVoxel=24, dVoxel=1, angles=[0.0])
    with pytest.raises(InputError, match=name.removesuffix('s')):
        Geometry.parallel(**scan | {name: value})


def test_angles_that_look_like_degrees_cause_a_warning():
    panel = dict(nDetector=32, dDetector=1, nVoxel=24, dVoxel=1)
    for angles in np.arange(360), np.arange(0, 180, 60):
        with pytest.warns(UserWarning, match='numpy.radians') as caught:
            Geometry.parallel(**panel, angles=angles)
        assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        Geometry.parallel(**panel, angles=np.arange(6))
        Geometry.cone(**panel, DSO=100, DSD=150, angles=circular(100, 1080))


def test_a_panel_that_is_hardly_one():
    """Steps that are nearly parallel are refused below an angle of 1e-9."""
    for angle, good in ((1.5e-9, True), (0.7e-9, False)):
        f = Rays(*(np.array([a]) for a in ([0, -9.0, 0], [0, 9.0, 0], [1.0, 0, 0], [1.0, 0, angle])), parallel=False)
        if good:
            f.checked()
        else:
            with pytest.raises(InputError, match='span no panel'):
                f.checked()
