"""Projections against RTK's on the CPU: cone, parallel, offset, turned, tilted, helical, curved.

Three comparisons, each for every geometry:

    ellipsoids   RTK's ray-ellipsoid filter is exact and in double precision; here the chords of `Rays.rays`. They agree
                 to 4e-8 of the largest value: what is left is the rounding of RTK's images to float32, 6e-8.
    a volume     RTK's Joseph projector and this package's, on the same voxels. They are two interpolants: Joseph's takes one
                 bilinear sample in each plane of voxel centres across the ray's main axis, this package integrates the
                 trilinear interpolant exactly. They differ by 0.4 to 1.1 % (norm) on voxels of 1 mm, most where a thin body
                 is seen along the grid, and by 0.08 to 0.21 % on voxels of half a millimetre: second order. The outermost
                 half voxel, where RTK's volume ends and this one holds its value, is left zero.
    a CT         the same of an abdomen, whose edges are sharp, given to RTK on its own voxels and, by linear interpolation,
                 which leaves the trilinear interpolant as it is, on ones of a half and a quarter. Joseph's sum is a
                 trapezoidal rule for what this package integrates exactly: the difference of 0.14 to 0.25 % (norm)
                 becomes 0.033 to 0.055 % and 0.008 to 0.013 %.

On circular scans this package's own Joseph projector is RTK's, to 7e-7 of the largest value. In one, parallel and offset, it is
to 6e-6.
"""

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import zoom

from helpers.bodies import BODIES, Ellipsoids
from lingo_mi.files.volumes import read_volume
from lingo_mi.geometry import CircularGeometry, Geometry, Grid
from lingo_mi.geometry.rtk import write_rtk as write_rtk
from lingo_mi.geometry.trajectories import helix, rotation
from lingo_mi.projectors.grid import project_volume
from lingo_mi.projectors.joseph import Joseph

try:
    import itk

    rtk = itk.RTK
except (ImportError, AttributeError):
    pytest.skip("RTK is not installed: pip install -e '.[reference]'", allow_module_level=True)

SHAPE, STEP = (48, 56), (1.6, 1.4)
ANGLES = np.radians([0.0, 37.0, 101.0, 180.0, 259.0, 330.0])
PLAIN = dict(DSO=300.0, DSD=450.0, nDetector=SHAPE, dDetector=STEP, angles=ANGLES)
GEOMETRIES = {
    'cone': {},
    'parallel': dict(mode='parallel'),
    'cone, offset': dict(offDetector=(9.0, -17.0)),
    'parallel, offset': dict(mode='parallel', offDetector=(9.0, -17.0)),
    'offset a view': dict(offDetector=np.random.default_rng(0).uniform(-9, 9, (6, 2)), DSO=300.0 + np.arange(6)),
    'panel turned': dict(rotDetector=np.radians([4.0, -6.0, 11.0])),
    'tilted': dict(tilt=np.radians(28.0)),
    'parallel, tilted': dict(tilt=np.radians(28.0), mode='parallel'),
    'helical': dict(height=helix(3 * ANGLES - 9.0, 11.0)),
    'curved': {},
    'curved, offset': dict(offDetector=(9.0, -17.0)),
    'curved, another radius': dict(offDetector=(9.0, 0.35), COR=5.0),
}
RADII = {'curved': 450.0, 'curved, offset': 450.0, 'curved, another radius': 400.0}


def geometry(name, n=40, side=40.0):
    return bent(name, Geometry.per_view(**{**PLAIN, **GEOMETRIES[name]}, nVoxel=(n, n + 4, n - 6), dVoxel=side / n))


def bent(name, g):
    return g.curved(RADII[name]) if name in RADII else g


@pytest.fixture(params=GEOMETRIES)
def name(request):
    return request.param


class RTK:
    """RTK's projectors in a geometry of this package, through RTK's own file."""

    def __init__(self, g, folder):
        self.g = g
        write_rtk(folder / 'geometry.xml', g.rays(curved=True), g.nDetector)
        reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New(Filename=str(folder / 'geometry.xml'))
        reader.GenerateOutputInformation()
        self.reader, self.geometry = reader, reader.GetOutputObject()

    def empty(self):
        (nv, nu), (dv, du) = self.g.nDetector, self.g.dDetector
        stack = itk.image_from_array(np.zeros((len(self.g), nv, nu), np.float32))
        stack.SetSpacing([float(du), float(dv), 1.0])
        stack.SetOrigin([-(nu - 1) / 2 * du, -(nv - 1) / 2 * dv, 0.0])
        return stack

    def rows_down(self, filter):
        filter.SetGeometry(self.geometry)
        filter.Update()
        return itk.array_from_image(filter.GetOutput())[:, ::-1].astype(float)

    def ellipsoid(self, centre, axes, density, angle):
        """Semi-axes (x, y, z) turned by `angle` degrees about z; RTK's angles about its y, our z, run the other way."""
        stack = self.empty()
        filter = rtk.RayEllipsoidIntersectionImageFilter[type(stack), type(stack)].New()
        filter.SetInput(stack)
        filter.SetCenter([float(x) for x in centre[[1, 2, 0]]])
        filter.SetAxis([float(x) for x in axes[[1, 2, 0]]])
        filter.SetAngle(-angle)
        filter.SetDensity(density)
        return self.rows_down(filter)

    def volume(self, values):
        g, stack = self.g, self.empty()
        image = itk.image_from_array(np.ascontiguousarray(values.transpose(0, 2, 1), np.float32))  # [x, z, y] of ours
        step, size = np.array(g.grid.spacing)[[1, 2, 0]], np.array(g.grid.shape)[[1, 2, 0]]
        image.SetSpacing([float(x) for x in step])
        image.SetOrigin([float(x) for x in np.array(g.grid.centre)[[1, 2, 0]] - (size - 1) / 2 * step])
        filter = rtk.JosephForwardProjectionImageFilter[type(stack), type(image)].New()
        filter.SetInput(0, stack)
        filter.SetInput(1, image)
        return self.rows_down(filter)


@pytest.mark.thorough
def test_rtk_reads_the_geometry(name, tmp_path):
    """From the file that this package wrote, RTK makes the same source positions."""
    g = geometry(name)
    if g.mode == 'parallel':
        pytest.skip('a parallel beam has no source')
    rtk_geometry = RTK(g, tmp_path).geometry
    sources = [np.array(rtk_geometry.GetSourcePosition(view))[[2, 0, 1]] for view in range(len(g))]
    np.testing.assert_allclose(sources, g.rays(curved=True).source, atol=1e-9)


def test_ellipsoids_are_exact(name, tmp_path):
    g, total, expected = geometry(name), 0.0, 0.0
    reference = RTK(g, tmp_path)
    for centre, axes, density, angle in (
        (np.array([8.0, -3.0, 5.0]), np.array([6.0, 4.0, 9.0]), 0.02, 0.0),
        (np.array([-7.0, 6.0, -4.0]), np.array([9.0, 2.0, 5.0]), 0.05, 35.0),
    ):
        body = Ellipsoids([(centre, rotation('z', np.radians(angle))[0] @ np.diag(axes), density)])
        expected = expected + reference.ellipsoid(centre, axes, density, angle)
        total = total + np.stack([body.image(g.rays(curved=True), view, SHAPE) for view in range(len(g))])
    assert expected.max() > 0.3
    assert np.abs(total - expected).max() < 1.2e-7 * expected.max()  # two images, each rounded to float32


def smooth(g):
    """A volume of ellipsoids with soft edges, zero at the border: [x, y, z]."""
    axes = [(np.arange(n) + 0.5 - n / 2) * d for n, d in zip(g.grid.shape, g.grid.spacing)]
    points = np.stack(np.meshgrid(*axes, indexing='ij'), -1)
    out = 0.0
    for centre, shape, density in BODIES.bodies:
        radius = np.linalg.norm((points - centre) @ np.linalg.inv(shape * 1.2).T, axis=-1)
        out = out + density * np.clip(1.5 - radius, 0, 1) ** 3
    return out.astype(np.float32)


def difference(name, n, folder):
    g = geometry(name, n)
    volume = smooth(g)
    expected = RTK(g, folder).volume(volume)
    return np.linalg.norm(project_volume(volume, g) - expected) / np.linalg.norm(expected)


def test_a_volume_agrees_to_second_order(name, tmp_path):
    coarse, fine = (difference(name, n, tmp_path) for n in (40, 80))
    assert coarse < 0.012
    assert fine < 0.0025 and fine < 0.35 * coarse


@pytest.fixture(scope='module')
def abdomen(data):
    """Every second voxel of a CT: [x, y, z], density of 6 mm voxels, with two layers of air around it, since RTK
    gives the first and the last plane that a ray meets in its volume other weights."""
    path = data / 'abdomen_ts.nii.gz'
    if not path.is_file():
        pytest.skip(f'LINGO_MI_DATA holds no {path.name}')
    out = read_volume(path).data[::2, ::2, ::2].copy()
    for axis in range(3):
        np.moveaxis(out, axis, 0)[[0, 1, -2, -1]] = 0
    return out


def wide(name):
    """The scanner `name`, large enough for the abdomen."""
    changes = GEOMETRIES[name]
    return {**PLAIN, **changes, 'DSO': 500.0 + changes.get('DSO', 300.0), 'DSD': 1200.0, 'dDetector': (13.0, 12.0)}


def test_a_ct_agrees_to_second_order(name, tmp_path, abdomen):
    image = project_volume(abdomen, bent(name, Geometry.per_view(**wide(name), nVoxel=abdomen.shape, dVoxel=6.0)))
    errors = []
    for finer in (1, 2, 4):
        shape = tuple(finer * (n - 1) + 1 for n in abdomen.shape)
        volume = zoom(abdomen, np.divide(shape, abdomen.shape), order=1) if finer > 1 else abdomen
        np.testing.assert_allclose(volume[::finer, ::finer, ::finer], abdomen, atol=1e-5)
        g = bent(name, Geometry.per_view(**wide(name), nVoxel=shape, dVoxel=6.0 / finer))
        expected = RTK(g, tmp_path).volume(volume)
        errors.append(np.linalg.norm(image - expected) / np.linalg.norm(expected))
    assert errors[0] < 0.003
    assert errors[1] < 0.26 * errors[0] and errors[2] < 0.26 * errors[1]


@pytest.mark.parametrize('name', ['cone', 'parallel', 'cone, offset', 'parallel, offset', 'curved', 'curved, offset'])
def test_joseph_is_rtks(name, tmp_path, abdomen):
    g = bent(name, CircularGeometry(**wide(name), grid=Grid(abdomen.shape, 6.0)))
    expected = RTK(g, tmp_path).volume(abdomen)
    actual = Joseph(g).forward(mi.Float(abdomen.ravel()), range(len(g)))[0].numpy()
    actual = actual.reshape(len(g), *SHAPE[::-1]).transpose(0, 2, 1)
    assert np.abs(actual - expected).max() < 1e-5 * expected.max()
