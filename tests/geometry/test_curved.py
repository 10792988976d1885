"""Curved panels: where their pixels are, by hand; what is made of them; bad input."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.bodies import BODIES
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.geometry import CircularGeometry, CurvedGeometry, Geometry, Grid, PosedGeometry, astra, circular, rtk
from lingo_mi.scan import Dataset, Scan

GRID = Grid((16, 18, 14), (2.0, 2.2, 1.8), (1.0, -2.0, 0.5))
PANEL = dict(nDetector=(12, 30), dDetector=(2.5, 6.0))  # an arc of 23 degrees at 450 mm
ANGLES = np.radians([0, 50, 145, 230, 311])
POINTS = np.random.default_rng(0).uniform(-15, 15, (20, 3))


def flat(**changes):
    return Geometry.cone(**{**dict(DSO=300.0, DSD=450.0, angles=ANGLES, grid=GRID), **PANEL, **changes})


def shaken():
    """Poses that no formula makes, with rows and columns at right angles."""
    rng = np.random.default_rng(3)
    g = flat(tilt=0.2, rotDetector=(0.05, -0.08, 0.2), COR=3.0, offDetector=(4.0, -9.0))
    rays = g.rays()
    return Geometry.from_poses(replace(rays, source=rays.source + rng.normal(size=(5, 3)) * 6), g.nDetector, grid=GRID)


KINDS = {
    'about the focal spot': flat().curved(),
    'a quarter pixel off': flat(offDetector=(3.0, 1.5)).curved(),
    'far off': flat(offDetector=(-3.0, 40.0)).curved(),
    'another radius': flat().curved(300.0),
    'a wide radius': flat(offDetector=(3.0, 10.0)).curved(2000.0),
    'helix': Geometry.helix(
        DSO=300, DSD=450, angles=ANGLES, pitch=20, grid=GRID, offDetector=(0, 1.5), **PANEL
    ).curved(),
    'flying spot': flat(offDetector=(0, 1.5)).curved().source_shifted(np.outer([-1, 1, -1, 1, -1], [2.0, 1.0, 0.5])),
    'shaken': CurvedGeometry(flat=shaken(), radius=430.0),
}


@pytest.fixture(params=KINDS)
def curved(request):
    return KINDS[request.param]


@pytest.mark.parametrize('shift', [0.0, 1.5, -37.0])
def test_pixels_lie_on_the_arc_about_the_focal_spot(shift):
    """By hand, the angle of a column from the central ray is its arc over DSD."""
    g = flat(offDetector=(4.0, shift)).curved()
    x, y = np.meshgrid(np.arange(30) + 0.5, np.arange(12) + 0.5)
    for view, a in enumerate(ANGLES):
        out, u, z = np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0]), np.array([0, 0, 1.0])
        fan = ((x - 15) * 6 + shift) / 450
        height = 4.0 - (y - 6) * 2.5
        expected = (
            (300 - 450 * np.cos(fan))[..., None] * out + (450 * np.sin(fan))[..., None] * u + height[..., None] * z
        )
        rays = g.rays(curved=True)
        np.testing.assert_allclose(rays.points(view, x, y), expected, atol=1e-9)
        start, direction = rays.through(view, x, y)
        to_pixel = expected - 300 * out
        cosine = (direction * to_pixel).sum(-1) / np.linalg.norm(direction, axis=-1) / np.linalg.norm(to_pixel, axis=-1)
        np.testing.assert_allclose(start, np.broadcast_to(300 * out, start.shape), atol=1e-9)
        np.testing.assert_allclose(cosine, 1, atol=1e-14)


def test_pixels_lie_on_their_cylinder(curved):
    """They are on it, evenly spaced along its arc, rows dDetector apart along its axis."""
    rays, g = curved.rays(curved=True), curved.flat
    for view in range(len(g)):
        f = g.rays()[[view]]
        u, v = f.u[0] / np.linalg.norm(f.u), f.v[0] / np.linalg.norm(f.v)
        up = np.cross(u, v) * np.sign((f.source - f.corner)[0] @ np.cross(u, v))
        axis = f.centre(g.nDetector)[0] + curved.radius * up
        p = rays.points(view, *np.meshgrid(np.arange(31.0), np.arange(13.0)))
        across = (p - axis) - ((p - axis) @ v)[..., None] * v
        np.testing.assert_allclose(np.linalg.norm(across, axis=-1), curved.radius, rtol=1e-12)
        angle = np.arctan2(across @ u, -across @ up)
        np.testing.assert_allclose(np.diff(angle, axis=1) * curved.radius, np.linalg.norm(f.u), rtol=1e-9)
        np.testing.assert_allclose(np.diff(p @ v, axis=0), np.linalg.norm(f.v), rtol=1e-9)
        assert (np.sum(across * (p - rays.source[view]), -1) > 0).all()  # from within


def test_project_inverts_through(curved):
    rays = curved.rays(curved=True)
    x, y = np.random.default_rng(1).uniform(0, 1, (2, 50)) * [[30], [12]]
    for view in range(len(curved)):
        start, direction = rays.through(view, x, y)
        np.testing.assert_allclose(rays.project(start + 0.7 * direction, view), [x, y], atol=1e-9)


def test_a_large_radius_is_flat():
    g = CurvedGeometry(flat=shaken(), radius=1e9)
    for view in range(len(g)):
        np.testing.assert_allclose(
            g.rays(curved=True).project(POINTS, view), shaken().rays().project(POINTS, view), atol=1e-5
        )


def test_the_same_curve_in_every_frame(curved):
    """A turn, a shift and the normalised frame change neither X nor Y; views are chosen with their curves."""
    rays = curved.rays(curved=True)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    moved = rays.moved(turn * np.linalg.det(turn), [3.0, -2.0, 9.0])[[1, 3]]
    points = POINTS @ (turn * np.linalg.det(turn)).T + [3.0, -2.0, 9.0]
    normalised = curved.normalised_rays(curved=True)
    inside = (POINTS - curved.grid.centre) * curved.grid.scale
    for i, view in enumerate((1, 3)):
        np.testing.assert_allclose(moved.project(points, i), rays.project(POINTS, view), atol=1e-9)
        np.testing.assert_allclose(normalised.project(inside, view), rays.project(POINTS, view), atol=1e-9)
        subset = curved.subset([1, 3]).rays(curved=True)
        np.testing.assert_allclose(subset.project(POINTS, i), rays.project(POINTS, view), atol=1e-9)


@pytest.mark.parametrize('columns', [30, 31, 32])
def test_binned(columns):
    """Three columns and rows become one, on the same arc; columns left over at the end are dropped."""
    g = flat(nDetector=(12, columns), offDetector=(3.0, 1.5)).curved()
    three = g.binned(3)
    assert three.nDetector == (4, 10) and isinstance(three, CurvedGeometry) and three.radius == g.radius
    for view in range(len(g)):
        x, y = g.rays(curved=True).project(POINTS, view)
        np.testing.assert_allclose(three.rays(curved=True).project(POINTS, view), [x / 3, y / 3], atol=1e-9)


def test_what_constructors_make():
    assert isinstance(flat().curved().flat, CircularGeometry)
    assert isinstance(flat(offDetector=(0, 1.5)).curved().flat, PosedGeometry)
    g = KINDS['helix']
    again = Geometry.from_poses(g.rays(curved=True), g.nDetector, grid=g.grid)
    assert isinstance(again, CurvedGeometry) and again.radius == pytest.approx(450, rel=1e-12)
    assert len(g.joined(g)) == 10 and g.on(GRID.slab(0, 2)).grid.shape == (16, 18, 2)
    assert (g.DSD, g.mode) == (g.flat.DSD, 'cone') and 'radius' in repr(g)
    moved = flat().source_shifted([1.0, 2.0, 3.0])
    np.testing.assert_allclose(moved.rays().source[0] - flat().rays().source[0], [3, 1, 2], atol=1e-12)
    np.testing.assert_array_equal(moved.rays().corner, flat().rays().corner)


BAD = {
    'radius must be positive': lambda: flat().curved(-450.0),
    'radius must be one finite number': lambda: flat().curved(np.nan),
    'arc of 180 degrees': lambda: flat(nDetector=(4, 100)).curved(600 / np.pi),
    'parallel beam has no curved': lambda: Geometry.parallel(angles=ANGLES, grid=GRID, **PANEL).curved(),
    'does not see the whole panel': lambda: flat().curved(300.0).source_shifted([1800.0, 0, 0]),
    'right angles': lambda: CurvedGeometry(
        flat=Geometry.from_poses(replace(flat().rays(), u=flat().rays().u + [0, 0, 1.0]), (4, 30), grid=GRID),
        radius=450.0,
    ),
    'curved already': lambda: flat().curved().curved(),
    'different radius': lambda: flat().curved().joined(flat().curved(500.0)),
    'and the panel of this scan is curved': lambda: flat().joined(flat().curved()),
    'no source to shift': lambda: Geometry.parallel(angles=ANGLES, grid=GRID, **PANEL).source_shifted([0, 0, 1]),
    'shift must be 3 numbers': lambda: flat().source_shifted([1.0, 2.0]),
}


@pytest.mark.parametrize('message', BAD)
def test_bad_input(message):
    with pytest.raises(InputError, match=message):
        BAD[message]()


# ---- other packages --------------------------------------------------------------------------------------------


def astra_pixels(vectors, view, x, y):
    """Return the positions of the pixels x, y in ASTRA's `cyl_cone_vec`: a restatement of `getCylConeAxes` and its kernels."""
    d, u, v, radius = vectors[view, 3:6], vectors[view, 6:9], vectors[view, 9:12], vectors[view, 12]
    along = -np.cross(u, v) * (radius / (np.linalg.norm(u) * np.linalg.norm(v)))
    across, axis = u * (radius / np.linalg.norm(u)), d - along
    angle = (x - 15) * np.linalg.norm(u) / radius
    return axis + np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * across + (y - 6)[:, None] * v


def test_astra(curved):
    """The pixels are where ASTRA has them, rows reversed, and come back."""
    vectors, rays = astra.to_cylinder_vectors(curved), curved.rays(curved=True)
    x, y = np.random.default_rng(1).uniform(0, 1, (2, 50)) * [[30], [12]]
    for view in range(len(curved)):
        np.testing.assert_allclose(astra_pixels(vectors, view, x, 12 - y), rays.points(view, x, y), atol=1e-9)
    dictionary = dict(type='cyl_cone_vec', DetectorRowCount=12, DetectorColCount=30, Vectors=vectors)
    again = Geometry.from_astra(dictionary, grid=GRID)
    assert isinstance(again, CurvedGeometry)
    for view in range(len(curved)):
        np.testing.assert_allclose(again.rays(curved=True).points(view, x, y), rays.points(view, x, y), atol=5e-3)
        # of a pixel of 2.5 mm: within its thousandth, poses become a circle
    for message, bad in {
        'bent away': vectors * ([1] * 9 + [-1] * 3 + [1]),
        '13 numbers for every view': vectors[:, :12],
        'the same for all': vectors + np.eye(13)[12] * np.arange(5)[:, None],
        'radius must be positive': vectors * ([1] * 12 + [-1]),
    }.items():
        with pytest.raises(InputError, match=message):
            Geometry.from_astra(dictionary | dict(Vectors=bad), grid=GRID)


def test_rtk(curved, tmp_path):
    path, rays = tmp_path / 'geometry.xml', curved.rays(curved=True)
    rtk.write_rtk(path, rays, curved.nDetector)
    again = Geometry.from_rtk(path, nDetector=curved.nDetector, dDetector=curved.dDetector, grid=GRID)
    assert isinstance(again, CurvedGeometry) and again.radius == pytest.approx(curved.radius, rel=1e-12)
    for view in range(len(curved)):
        np.testing.assert_allclose(again.rays(curved=True).project(POINTS, view), rays.project(POINTS, view), atol=1e-3)
    path.write_text(
        path.read_text().replace(
            '<Projection>', '<Projection><RadiusCylindricalDetector>7</RadiusCylindricalDetector>', 1
        )
    )
    with pytest.raises(InputError, match='the same for all views'):
        Geometry.from_rtk(path, nDetector=curved.nDetector, dDetector=curved.dDetector, grid=GRID)


def test_scan_files(curved, tmp_path):
    scan = Scan(curved, np.random.default_rng(0).random((5, 12, 30), np.float32))
    for name, kind in (('scan.npy', 'npy'), ('folder', 'exr')):
        write_scan(
            tmp_path / name, Dataset(scan.subset([0, 2, 3, 4]), scan.subset([1])) if kind == 'exr' else scan, kind
        )
        read = read_scan(tmp_path / name)
        again = read.train.geometry.joined(read.test.geometry) if read.test else read.train.geometry
        order = [0, 2, 3, 4, 1] if read.test else range(5)
        assert isinstance(again, CurvedGeometry) and again.radius == curved.radius
        for i, view in enumerate(order):
            np.testing.assert_allclose(
                again.rays(curved=True).project(POINTS, i), curved.rays(curved=True).project(POINTS, view), atol=1e-3
            )
    for kind in ('naf', 'r2'):
        with pytest.raises(InputError, match="write it as 'npy' or 'exr'"):
            write_scan(tmp_path / kind, scan, kind)


CLINICAL = """
DSO: 300
DSD: 450
nDetector: [12, 30]
dDetector: [2.5, 6]
nVoxel: 16
dVoxel: 2
angles: [0, 50]
offDetector: [0, 1.5]
"""


def test_the_name_in_a_geometry_file(tmp_path):
    np.save(tmp_path / 'scan.npy', np.zeros((2, 12, 30), np.float32))
    (tmp_path / 'scan.yml').write_text(CLINICAL + 'radius: 450\n')
    geometry = read_scan(tmp_path / 'scan.npy').train.geometry
    expected = flat(angles=np.radians([0, 50]), offDetector=(0, 1.5)).curved()
    np.testing.assert_allclose(
        geometry.rays(curved=True).project(POINTS, 1), expected.rays(curved=True).project(POINTS, 1)
    )
    for line, message in {
        'radius: -450': 'radius must be positive',
        'radius: wide': 'radius must be one number',
        'radius: 50': 'arc of 206.3 degrees',
        'radius: 450\nmode: parallel': 'a parallel beam has no curved panel',
    }.items():
        (tmp_path / 'scan.yml').write_text(CLINICAL + line + '\n')
        with pytest.raises(InputError, match=message) as error:
            read_scan(tmp_path / 'scan.npy')
        assert 'scan.yml' in str(error.value)


# ---- on a flat panel ------------------------------------------------------------------------------------------


def bodies(g):
    return Scan(g, np.array([BODIES.image(g.rays(curved=True), view, g.nDetector) for view in range(len(g))]))


def smooth(g):
    """Line integrals of a round Gaussian, 5 mm wide: what a fine panel samples well."""
    out = []
    for view in range(len(g)):
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in g.nDetector[::-1]))
        o, d = g.rays(curved=True).through(view, x, y)
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        near = np.cross(o - [2.0, -3.0, 1.0], d)
        out.append(np.exp(-0.5 * (near**2).sum(-1) / 25))
    return Scan(g, np.array(out))


@pytest.mark.parametrize('fine, error', [(1, 3e-2), (2, 2e-3), (4, 1.5e-4)])
def test_resampling_converges(curved, fine, error):
    """The error on a flat panel falls with the fourth power of the pixels, like the error of cubic splines."""
    (rows, columns), step, rays = curved.nDetector, np.array(curved.dDetector) / fine, curved.flat.rays()
    # Three times as high and twice as wide: the body is not cut.
    rays = replace(rays, corner=rays.corner - rows * rays.v - columns / 2 * rays.u, u=rays.u / fine, v=rays.v / fine)
    level = Geometry.from_poses(rays, (3 * rows * fine, 2 * columns * fine), grid=GRID)
    g = CurvedGeometry(flat=level, radius=curved.radius)
    actual = smooth(g).to_flat()
    expected = smooth(actual.geometry)
    assert not isinstance(actual.geometry, CurvedGeometry) and actual.valid is None
    assert np.abs(actual.projections - expected.projections).max() < error
    np.testing.assert_allclose(actual.geometry.dDetector, step, rtol=1e-9)


def test_resampling_keeps_flat_scans_and_masks():
    g = flat().curved()
    scan = bodies(g)
    masked = replace(scan, valid=np.indices(scan.projections.shape)[2] != 14)
    actual, (_, _, left, _) = masked.to_flat(), g.flat_pixels()
    x, _ = g.rays(curved=True).curve.on_panel(np.arange(actual.projections.shape[2]) + left + 0.5, 6.0, 0)
    np.testing.assert_array_equal(actual.valid[0, 0], np.abs(x - 14.5) >= 1)
    there = bodies(flat())
    assert there.to_flat() is there
    assert (
        scan.digest() != replace(scan, geometry=flat()).digest() != replace(scan, geometry=flat().curved(400)).digest()
    )


def test_rows_that_all_columns_see():
    """The flat panel's rows are within the curved one's, in all columns; its columns reach out to the last whole ones."""
    g = flat(nDetector=(12, 120), dDetector=(2.5, 6.0)).curved()  # 92 degrees
    level = g.to_flat()
    x, y = np.meshgrid(*(np.linspace(0, n, 9) for n in level.nDetector[::-1]))
    for view in range(len(g)):
        start, direction = level.rays().through(view, x, y)
        column, row = g.rays(curved=True).project((start + direction).reshape(-1, 3), view)
        assert column.min() > -1e-6 and column.max() < 120 + 1e-6 and row.min() > -1e-6 and row.max() < 12 + 1e-6
    assert level.nDetector == (12, 2 * int(450 * np.tan(360 / 450) / 6))


def test_drawn():
    g = flat().curved()
    assert 'svg' in g._repr_html_()
    outline = g.rays(curved=True).outline(0, g.nDetector)
    np.testing.assert_allclose(np.linalg.norm(outline[:, :2] - [300.0, 0.0], axis=1), 450, rtol=1e-9)
    axes = g.show().axes[0]
    drawn = np.concatenate([line.get_xydata() for line in axes.lines if len(line.get_xdata()) > 20])
    far = np.linalg.norm(drawn - [300.0, 0.0], axis=1)
    assert np.isclose(far, 450).sum() >= 32


def test_circular_angles_are_those_of_the_flat_scan():
    assert np.array_equal(flat(angles=circular(7)).curved().angles, circular(7))
