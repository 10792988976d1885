"""Voxels before curved panels, against flat panels of one column each, which have the same rays."""

import mitsuba as mi
import numpy as np
import pytest

from helpers.motions import climbing, curved, tilted
from lingo_mi.functional import Projector
from lingo_mi.geometry import CurvedGeometry, Geometry, Grid, PosedGeometry, Rays, circular
from lingo_mi.projectors import bent
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.joseph import Joseph
from lingo_mi.projectors.tilted_joseph import TiltedJoseph

GEOMETRIES = {
    'about the focal spot': curved(),
    'a wide radius': curved(radius=900.0),
    'a small radius': curved(radius=170.0),
    'helix': curved(climbing),
    'flying spot': curved().source_shifted([[-5.0, 2.0, 1.0], [5.0, -2.0, -1.0], [0.0, 0.0, 4.0]]),
    'tilted': curved(tilted(0.6, 0.0, 0.0)),
    'source in the volume': curved(DSO=10.0, DSD=300.0),
}


@pytest.fixture(params=GEOMETRIES)
def geometry(request):
    return GEOMETRIES[request.param]


def columns_of(geometry):
    """The same rays, with each column of each view as a flat panel of its own, column by column."""
    rays, columns = geometry.rays(curved=True), range(geometry.nDetector[1])
    tops = np.array([rays.points(view, c + 0.5, 0.0) for view in range(len(geometry)) for c in columns])
    source, u, v = (np.repeat(a, len(columns), 0) for a in (rays.source, rays.u, rays.v))
    poses = Rays(source, tops - u / 2, u, v, False)
    return PosedGeometry(poses=poses, nDetector=(geometry.nDetector[0], 1), grid=geometry.grid)


def same(actual, geometry, columns):
    (n_v, n_u), n = geometry.nDetector, len(geometry)
    expected = columns.reshape(n, n_u, n_v).transpose(0, 2, 1)
    np.testing.assert_allclose(actual, expected, atol=3e-5 * np.abs(expected).max())


@pytest.fixture
def volume(geometry):
    return np.random.default_rng(0).random(geometry.grid.shape, np.float32)


def test_line_integrals(geometry, volume):
    """The exact model agrees to rounding, and so does Joseph's, which depends on rays alone."""
    columns = columns_of(geometry)
    same(project_volume(volume, geometry), geometry, project_volume(volume, columns))
    same(Projector(geometry, model='exact')(volume), geometry, project_volume(volume, columns))
    A = Projector(geometry)
    same(A(volume), geometry, Projector(columns)(volume))
    assert A.model == ('exact' if geometry.DSO < 20 else 'joseph')


def test_projector_classes():
    kinds = {name: Projector(g)._kind.__name__ for name, g in GEOMETRIES.items()}
    assert kinds.pop('tilted') == 'TiltedJoseph' and kinds.pop('source in the volume') == 'GridPair'
    assert set(kinds.values()) == {'Joseph'}


@pytest.mark.parametrize('kind', [Joseph, TiltedJoseph])
def test_backprojections_agree(kind):
    """Each voxel gathers the pixels that it is projected to."""
    geometry = GEOMETRIES['flying spot']
    A = kind(geometry)
    y = np.random.default_rng(1).random((3, *geometry.nDetector), np.float32)
    actual = A.adjoint(A.images(y), range(3)).numpy()
    ones = np.zeros(A.voxels, np.float32)
    for voxel in (0, 40, 346, 692):
        ones[voxel] = 1
        image = A.forward(mi.Float(ones), range(3))[0].numpy().reshape(3, 41, 17).transpose(0, 2, 1)
        assert actual[voxel] == pytest.approx(np.vdot(image, y), rel=1e-5)
        ones[voxel] = 0


def test_columns_of_positions(geometry):
    """The device agrees with float64 to a thousandth of a pixel; SLACK and the margins of Joseph's columns allow more."""
    curve = geometry.rays(curved=True).curve
    x = np.linspace(-2, 43, 400)
    for view in range(len(geometry)):
        numbers = [mi.Float(n) for n in curve.numbers[view]]
        X, y = curve.on_plane(x, 0 * x, view)
        np.testing.assert_allclose(bent.column_of(numbers, mi.Float(X)).numpy(), x, atol=1e-3)
        np.testing.assert_allclose(curve.on_panel(X, y, view), [x, 0 * x], atol=1e-9)


def test_a_clinical_scanner():
    """736 columns about the focal spot, a quarter of a pixel off, see the line integrals of a Gaussian near the fan's edge."""
    centre, width, side = np.array([120.0, 110.0, 0.0]), 4.0, 64
    flat = Geometry.helix(
        DSO=595, DSD=1085.6, nDetector=(16, 736), dDetector=(1.2, 1.2858), offDetector=(0, 1.2858 / 4), pitch=12,
        angles=circular(4, total=720, start=-360), grid=Grid(side, 48 / side, centre),
    )  # fmt: skip
    g = flat.curved()
    x = (np.arange(side) + 0.5) * (48 / side) - 24
    volume = np.exp(-0.5 * (np.stack(np.meshgrid(x, x, x, indexing='ij')) ** 2).sum(0) / width**2)
    expected = np.empty((4, *g.nDetector))
    for view in range(4):
        o, d = g.rays(curved=True).through(view, *np.meshgrid(np.arange(736) + 0.5, np.arange(16) + 0.5))
        near = np.cross(o - centre, d / np.linalg.norm(d, axis=-1, keepdims=True))
        expected[view] = np.sqrt(2 * np.pi) * width * np.exp(-0.5 * (near**2).sum(-1) / width**2)
    assert isinstance(g, CurvedGeometry) and Projector(g)._kind is Joseph
    for actual in (project_volume(volume, g), Projector(g)(volume)):
        assert np.linalg.norm(actual - expected) / np.linalg.norm(expected) < 0.01  # of the voxels
    assert np.linalg.norm(project_volume(volume, flat) - expected) / np.linalg.norm(expected) > 0.1
