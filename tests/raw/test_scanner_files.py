"""Files in which Bruker's, GE's and North Star Imaging's scanners say where frames were taken."""

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.raw.bruker import read_skyscan_log
from lingo_mi.raw.nsi import read_nsipro
from lingo_mi.raw.phoenix import read_pca

SKYSCAN = """[System]
Scanner=SkyScan1272
Camera Pixel Size (um)=9.0
[Acquisition]
Filename Prefix=14~01
Number Of Files=  4
Number Of Rows=  6
Number Of Columns= 8
Camera binning=4x4
Image Rotation=0.0
Optical Axis (line)=  3
Camera to Source (mm)=273.83609
Object to Source (mm)=200.89000
Image Pixel Size (um)=26.413040
Rotation Step (deg)=0.600
Scan duration=0h:25m:46s
[Reconstruction]
Reconstruction Program=NRecon
"""
PHOENIX = """[Geometry]
FDD=399.99900000
FOD=16.60243750
Magnification=24.09278758
CalibValue=0
DetectorRot=0.00000000
[CT]
NumberImages=4
RotationSector=360.00000000
[Detector]
PixelsizeX=0.05000000
PixelsizeY=0.06000000
NrPixelsX=8
NrPixelsY=6
"""
# In its world x points to the left of who looks from the source to the panel, y up, z away from the source.
NSI = """<NSI Reconstruction Project>
<CT Project Configuration>
  <Object Radiograph>
    <number>4
    <angleStep>90
    <pitch>0.2 0.25
  </Object Radiograph>
  <Detector>
    <width pixels>8
    <height pixels>6
  </Detector>
  <Correction>
    <rotate>0
    <flipH>False
    <flipV>False
  </Correction>
  <Processed>
    <clockwise>True
  </Processed>
</CT Project Configuration>
<Result>
  <source>0 0 -300
  <reference>0.6 0.875 500
  <axis>0 -1 0
  <normal>0 0 1
  <horizontal>-1 0 0
</Result>
"""
KINDS = {'.log': (SKYSCAN, read_skyscan_log), '.pca': (PHOENIX, read_pca), '.nsipro': (NSI, read_nsipro)}


@pytest.fixture
def scan_of(tmp_path):
    def load(suffix, old='', new=''):
        path = tmp_path / f'scan{suffix}'
        path.write_text(KINDS[suffix][0].replace(old, new, 1))
        views = np.full((4, 6, 8), 1000 * np.exp(-1), np.float32)
        views[:, 0, 0] = 1000 * np.exp(-2)
        np.save(tmp_path / 'v.npy', views)
        return lm.load_raw(tmp_path / 'v.npy', path, i0=1000, progress=False)

    return load


def test_skyscan(scan_of):
    """The panel's pixel is four of the camera's, as its calibrated size at the object says."""
    geometry = scan_of('.log').geometry
    assert (geometry.DSO, geometry.DSD) == (200.89, 273.83609)
    np.testing.assert_allclose(geometry.dDetector, 4 * 0.009, rtol=2e-4)
    np.testing.assert_allclose(np.degrees(geometry.angles), [0, 0.6, 1.2, 1.8])


def test_phoenix(scan_of):
    geometry = scan_of('.pca').geometry
    assert (geometry.DSO, geometry.DSD, geometry.dDetector) == (16.6024375, 399.999, (0.06, 0.05))
    np.testing.assert_allclose(np.degrees(geometry.angles), [0, 90, 180, 270])


def test_nsi(scan_of):
    """The first pixel's centre is half a pixel right of where a centred panel has it, and a whole one up."""
    scan = scan_of('.nsipro')
    geometry = scan.geometry
    assert (geometry.DSO, geometry.DSD, *geometry.dDetector) == pytest.approx((300, 800, 0.25, 0.2))
    assert geometry.offDetector == pytest.approx((0.25, 0.1))
    np.testing.assert_allclose(np.degrees(geometry.angles) % 360, [0, 90, 180, 270], atol=1e-9)
    assert scan.projections[0, 0, 0] == pytest.approx(2, rel=1e-5)
    turned = scan_of('.nsipro', 'clockwise>True', 'clockwise>False').geometry
    np.testing.assert_allclose(np.degrees(turned.angles) % 360, [0, 270, 180, 90], atol=1e-9)
    for old, new, place in (
        ('flipH>False', 'flipH>True', (0, -1)),
        ('flipV>False', 'flipV>True', (-1, 0)),
        ('rotate>0', 'rotate>180', (-1, -1)),
    ):
        assert scan_of('.nsipro', old, new).projections[(0, *place)] == pytest.approx(2, rel=1e-5)


def test_nsi_with_a_turned_panel(scan_of):
    """If rows are at 2 degrees to the plane of rotation, poses hold the rays of the file's own vectors."""
    c, s = np.cos(np.radians(2)), np.sin(np.radians(2))
    geometry = scan_of('.nsipro', '<horizontal>-1 0 0', f'<horizontal>{-c} {s} 0').geometry
    rays = geometry.rays()
    ours = np.array([[0, 0, -1.0], [-1, 0, 0], [0, 1, 0]])  # x towards the source, y to the right, z up
    np.testing.assert_allclose(rays.source[0], ours @ [0, 0, -300], atol=1e-9)
    np.testing.assert_allclose(rays.u[0], ours @ [-0.2 * c, 0.2 * s, 0], atol=1e-9)
    first = rays.corner[0] + (rays.u[0] + rays.v[0]) / 2
    np.testing.assert_allclose(first, ours @ [0.6, 0.875, 500], atol=1e-9)


def test_nsi_as_mbirjax_reads_it():
    """The numbers of a circle, signs included, are those of the functions of MBIRJAX's own reader."""
    nsi = pytest.importorskip(
        'mbirjax.preprocess.nsi', reason="MBIRJAX is not installed: pip install -e '.[reference]'"
    )
    vectors = [np.array(v, float) for v in ((0, -1, 0), (0, 0, 1), (-1, 0, 0), (0, 0, -300), (0.6, 0.875, 500))]
    DSD, DSO, magnification, turn = nsi.calc_source_detector_params(*vectors)
    across, along = nsi.calc_row_channel_params(*vectors, 0.2, 0.25, 8, 6, magnification)
    assert (DSD, DSO, turn) == pytest.approx((800, 300, 0))
    assert (across, along) == pytest.approx((-0.1, 0.25))  # offDetector (v, u) is (row offset, - channel offset) there


@pytest.mark.parametrize(
    ('suffix', 'old', 'new', 'message'),
    [
        ('.log', 'Object to Source (mm)=200.89000\n', '', r'Object to Source \(mm\) is missing; give the .log'),
        ('.log', 'Number Of Files=  4', 'Number Of Files=5', 'describes 5 views, but there are 4 frames'),
        ('.log', '[Acquisition]', '[Other]', r'has no section \[Acquisition\]'),
        ('.log', 'Rotation Step (deg)=0.600', 'Rotation Step (deg)=0,6', 'must be a number'),
        ('.pca', 'FOD=16.6', 'FOD=1600', 'needs NumberImages from 1 to 100000 and FDD >= FOD > 0'),
        ('.pca', '[Geometry]', '', 'is not a .pca file'),
        ('.pca', 'PixelsizeX=0.05000000\n', '', 'PixelsizeX is missing'),
        ('.nsipro', '<source>0 0 -300', '', 'source of <Result> is missing'),
        ('.nsipro', '<source>0 0 -300', '<source>0 0', 'source of <Result> must be 3 numbers'),
        ('.nsipro', '<rotate>0', '<rotate>90', 'turned by 90 degrees'),
        ('.nsipro', '<axis>0 -1 0', '<axis>0 0 0', 'vectors that are not zero'),
        ('.nsipro', '<width pixels>8', '<width pixels>9', r'4 frames of \(6, 8\) pixels, but .* 4 views of \(6, 9\)'),
    ],
)
def test_damaged(scan_of, suffix, old, new, message):
    with pytest.raises(lm.InputError, match=message) as caught:
        scan_of(suffix, old, new)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('suffix', 'old', 'new'),
    [
        ('.log', '(line)=  3', '(line)=  5'),
        ('.log', 'Rotation=0.0', 'Rotation=-0.35'),
        ('.pca', 'Value=0', 'Value=-1.1'),
    ],
)
def test_what_is_not_read_is_said(scan_of, suffix, old, new):
    with pytest.warns(UserWarning, match='is not read: calibrate the scan if its axis is off'):
        scan_of(suffix, old, new)
