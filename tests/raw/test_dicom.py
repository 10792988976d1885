"""DICOM projections: rays by the standards' own formulas, line integrals of balls, and a helical scan reconstructed."""

import shutil
import sys

import numpy as np
import pytest

import lingo_mi as lm
from helpers.dicom_projections import CTPD, balls, write_xa
from lingo_mi.cli import main
from lingo_mi.geometry import Grid

pydicom = pytest.importorskip('pydicom', minversion='3.0')
SPHERES = [(12.0, -8.0, -146.0, 16.0, 0.02), (-20.0, 10.0, -158.0, 10.0, 0.03)]


def load(path, geometry=None, **options):
    return lm.load_raw(path, geometry, progress=False, **options)


def pixel_rays(geometry, view):
    """Source [3] and a point of the ray of every pixel [v, u, 3] of a scan."""
    rays, (nv, nu) = geometry.rays(curved=True), geometry.nDetector
    x, y = np.arange(nu) + 0.5, np.arange(nv)[:, None] + 0.5
    if rays.curve is not None:
        x, y = rays.curve.on_plane(x, y, view)
    points = rays.corner[view] + np.broadcast_to(x, (nv, nu))[..., None] * rays.u[view]
    return rays.source[view], points + np.broadcast_to(y, (nv, nu))[..., None] * rays.v[view]


def directions(source, points):
    return (points - source) / np.linalg.norm(points - source, axis=-1, keepdims=True)


@pytest.mark.parametrize('flying', [False, True])
@pytest.mark.parametrize('shape', ['CYLINDRICAL', 'FLAT'])
@pytest.mark.parametrize('stored', [dict(), dict(direct=True), dict(implicit=True)], ids=str)
def test_every_ray_of_a_ct_pd_scan(tmp_path, flying, shape, stored):
    """Rays run from the focal spot to the element of the manual's formulas, as exactly as float32 attributes say, and hold
    their line integrals."""
    scanner = CTPD(views=7, turns=1.3, flying=flying, shape=shape)
    p = scanner.projections(SPHERES)
    scanner.write(tmp_path / 'scan', p, **stored)
    scan = load(tmp_path / 'scan')
    np.testing.assert_allclose(scan.projections, p[:, :, ::-1], atol=p.max() / 60000)  # half a stored step
    for view in range(7):
        source, points = pixel_rays(scan.geometry, view)
        np.testing.assert_allclose(source, scanner.sources()[view], atol=1e-3)
        expected = directions(scanner.sources()[view], scanner.elements()[view][:, ::-1])
        np.testing.assert_allclose(directions(source, points), expected, atol=1e-6)


@pytest.mark.filterwarnings('ignore:.*projections may be truncated')
def test_a_helical_ct_pd_scan_is_reconstructed(tmp_path, monkeypatch):
    """The command imports two balls with closed-form line integrals, and CGLS finds their densities and places."""
    scanner = CTPD(views=90, flying=True)
    scanner.write(tmp_path / 'scan', scanner.projections(SPHERES))
    monkeypatch.setattr(sys, 'argv', ['lingo-mi', 'import', str(tmp_path / 'scan'), '--out', str(tmp_path / 's.npy')])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    scan = lm.load(tmp_path / 's.npy').train
    assert scan.geometry.radius == pytest.approx(1085.6)
    seen = scan.geometry.grid
    assert seen.low[2] < -170 and seen.high[2] > -130 and abs(seen.centre[2] + 150) < 3
    grid = Grid((32, 32, 24), 2.5, (0.0, 0.0, -150.0))
    result = lm.reconstruct(lm.Scan(scan.geometry.on(grid), scan.projections), lm.CGLS(niter=15), progress=False)
    volume = np.asarray(result.volume)
    axes = [low + 2.5 * (np.arange(n) + 0.5) for low, n in zip(grid.low, grid.shape)]
    points = np.stack(np.meshgrid(*axes, indexing='ij'), -1)
    for *centre, radius, density in SPHERES:
        far = np.linalg.norm(points - centre, axis=-1)
        assert volume[far < radius - 3].mean() == pytest.approx(density, rel=0.03)
        near = np.where(far < radius + 4, volume, 0)
        np.testing.assert_allclose((points * near[..., None]).sum((0, 1, 2)) / near.sum(), centre, atol=0.4)


@pytest.mark.parametrize(
    ('tag', 'message'),
    [
        (0x70311001, r'DetectorFocalCenterAngularPosition \(7031,1001\) is missing; .*: geometry=FILE'),
        (0x70311031, r'ConstantRadialDistance \(7031,1031\) is missing'),
        (0x7029100B, r'DetectorShape \(7029,100B\) must be CYLINDRICAL or FLAT'),
    ],
)
def test_a_ct_pd_scan_that_lacks_an_attribute(tmp_path, tag, message):
    scanner = CTPD(views=3)
    scanner.write(tmp_path / 'scan', scanner.projections(SPHERES), without=[tag])
    with pytest.raises(lm.InputError, match=message):
        load(tmp_path / 'scan')
    path = tmp_path / 'scan.yml'
    path.write_text('DSO: 595\nDSD: 1085.6\ndDetector: 4\nradius: 1085.6\nangles: [0, 1, 2]\n')
    assert len(load(tmp_path / 'scan', path)) == 3


def test_a_ct_pd_scan_needs_no_flats(tmp_path):
    scanner = CTPD(views=3)
    scanner.write(tmp_path / 'scan', scanner.projections(SPHERES))
    with pytest.raises(lm.InputError, match='corrected already: leave out flats and darks'):
        load(tmp_path / 'scan', flats=tmp_path / 'scan')
    shutil.copy(tmp_path / 'scan' / '0001.dcm', tmp_path / 'scan' / 'x.dcm')
    data = pydicom.dcmread(tmp_path / 'scan' / 'x.dcm')
    data[0x70311031].value = 1000.0
    data.save_as(tmp_path / 'scan' / 'x.dcm')
    with pytest.raises(lm.InputError, match=r'x.dcm: ConstantRadialDistance .* differs from'):
        load(tmp_path / 'scan')


@pytest.mark.parametrize('crop', [(0, 12, 0, 40), (2, 9, 5, 31)])
@pytest.mark.parametrize('binning', [1, 2])
def test_part_of_a_curved_panel(tmp_path, crop, binning):
    """A crop has the rays of its pixels; a bin's ray is in the middle of its pixels' corners."""
    scanner = CTPD(views=2, turns=0.1)
    scanner.write(tmp_path / 'scan', scanner.projections(SPHERES))
    v0, v1, u0, u1 = crop
    part = load(tmp_path / 'scan', crop=crop, binning=binning).geometry
    elements = scanner.elements()[:, v0:v1, u0:u1][:, :, ::-1]
    if binning == 2:
        rows, columns = ((n // 2) * 2 for n in (v1 - v0, u1 - u0))
        blocks = elements[:, :rows, :columns].reshape(2, rows // 2, 2, columns // 2, 2, 3)
        elements = blocks.mean((2, 4))
    for view in range(2):
        source, points = pixel_rays(part, view)
        expected = directions(scanner.sources()[view], elements[view])
        np.testing.assert_allclose(directions(source, points), expected, atol=1e-6)


def c_arm(primary, secondary, columns=9, rows=7):
    """Sources [n, 3] and pixels [n, v, u, 3] of a C-arm by DICOM's words: x to the patient's right, y front, z head."""
    p, s = np.radians(primary), np.radians(secondary)
    detector = np.stack([-np.sin(p) * np.cos(s), np.cos(p) * np.cos(s), np.sin(s)], -1)
    left = np.stack([-np.cos(p), -np.sin(p), 0 * p], -1)  # seen in a view of the chest, and turned with the arm
    down = np.cross(left, detector)
    i, j = np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2
    across = 0.6 * i[:, None] * left[:, None, None]
    along = 0.8 * j[:, None, None] * down[:, None, None]
    return -750 * detector, (1200 - 750) * detector[:, None, None] + across + along


BALL = [(-0.9, 0.4, 0.6, 1.0, 0.4)]  # towards the left, front and head


@pytest.mark.parametrize('steps', [30.0, [0.0, 30.0, 60.0, 90.0]], ids=['one step', 'offsets'])
@pytest.mark.parametrize('secondary', [None, 20.0])
def test_a_rotational_run_of_angiography(tmp_path, steps, secondary):
    sources, pixels = c_arm(np.array([-40.0, -10, 20, 50]), np.full(4, secondary or 0.0))
    p = balls(sources[:, None, None], pixels, BALL)
    write_xa(tmp_path / 'run', np.rint(4000 * np.exp(-p)), -40.0, secondary, steps)  # as scanners name it: no suffix
    scan = load(tmp_path / 'run', i0=4000)
    np.testing.assert_allclose(scan.projections, p[:, :, ::-1], atol=4e-4)  # one count in 4000, at p < 1
    for view in range(4):
        source, points = pixel_rays(scan.geometry, view)
        np.testing.assert_allclose(source, sources[view], atol=1e-9)
        np.testing.assert_allclose(points, pixels[view][:, ::-1], atol=1e-9)


def test_single_frames_and_what_turns_them(tmp_path):
    """There is one file a view, and PatientOrientation says that columns run to the right hand."""
    (tmp_path / 'run').mkdir()
    primary = np.array([-80.0, 10.0, 100.0])
    sources, pixels = c_arm(primary, np.zeros(3))
    p = balls(sources[:, None, None], pixels, BALL)
    for k in (2, 0, 1):
        counts = np.rint(4000 * np.exp(-p[k : k + 1, :, ::-1]))
        toward = dict(PatientOrientation=[('P', 'R', 'A')[k], 'F'], InstanceNumber=k + 1)
        write_xa(tmp_path / 'run' / f'{9 - k}.dcm', counts, primary[k], **toward)
    (tmp_path / 'run' / 'DICOMDIR').write_bytes(bytes(128) + b'DICM')
    scan = load(tmp_path / 'run', i0=4000)
    np.testing.assert_allclose(scan.projections, p[:, :, ::-1], atol=4e-4)
    np.testing.assert_allclose(scan.geometry.angles, np.radians(primary - 90), atol=1e-9)


def test_enhanced_angiography(tmp_path):
    """Angles are in the groups of the frames, distances in the group of all."""
    Dataset, Sequence = pydicom.Dataset, pydicom.Sequence
    frames = []
    for angle in (0.0, 40.0):
        position, item = Dataset(), Dataset()
        position.PositionerPrimaryAngle, position.PositionerSecondaryAngle = angle, 5.0
        item.PositionerPositionSequence = Sequence([position])
        frames.append(item)
    shared, distances = Dataset(), Dataset()
    distances.DistanceSourceToIsocenter, distances.DistanceSourceToDetector = 750, 1200
    shared.XRayGeometrySequence = Sequence([distances])
    groups = dict(PerFrameFunctionalGroupsSequence=Sequence(frames), SharedFunctionalGroupsSequence=Sequence([shared]))
    gone = ['PositionerPrimaryAngle', 'DistanceSourceToPatient', 'DistanceSourceToDetector']
    write_xa(tmp_path / 'a.dcm', np.full((2, 7, 9), 2000), 0.0, without=gone, **groups)
    geometry = load(tmp_path / 'a.dcm', i0=4000).geometry
    sources, _ = c_arm(np.array([0.0, 40.0]), np.full(2, 5.0))
    np.testing.assert_allclose(geometry.rays().source, sources, atol=1e-9)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (
            dict(without=['DistanceSourceToPatient']),
            r'DistanceSourceToPatient \(0018,1111\) is missing; .*geometry=FILE',
        ),
        (dict(without=['ImagerPixelSpacing']), r'ImagerPixelSpacing \(0018,1164\) is missing'),
        (dict(without=['PositionerPrimaryAngle']), r'PositionerPrimaryAngle \(0018,1510\) is missing'),
        (dict(without=['PositionerPrimaryAngleIncrement']), r'PrimaryAngleIncrement \(0018,1520\) is missing'),
        (dict(steps=[0.0, 1.0, 2.0]), r'PositionerPrimaryAngle.*'),
        (dict(PixelIntensityRelationship='DISP'), "is 'DISP', and no ModalityLUTSequence"),
        (dict(PixelIntensityRelationshipSign=-1), 'its pixels fall with the intensity'),
        (dict(ImagePositionPatient=[0, 0, 0]), 'is not a projection, but a slice or a volume'),
        (dict(NumberOfFrames=2_000_000_000), 'NumberOfFrames .* must be from 1 to 100000'),
        (dict(SamplesPerPixel=3), 'has no image of one value a pixel'),
    ],
    ids=str,
)
def test_a_run_that_says_too_little(tmp_path, change, message):
    arguments = dict(primary=0.0, steps=1.0) | {k: v for k, v in change.items() if k != 'SamplesPerPixel'}
    write_xa(tmp_path / 'a.dcm', np.full((2, 7, 9), 2000), **arguments)
    if 'SamplesPerPixel' in change:
        data = pydicom.dcmread(tmp_path / 'a.dcm')
        data.SamplesPerPixel = 3
        data.save_as(tmp_path / 'a.dcm')
    with pytest.raises(lm.InputError, match=message):
        load(tmp_path / 'a.dcm', i0=4000)


def test_damaged_files(tmp_path):
    path = tmp_path / 'a.dcm'
    write_xa(path, np.full((2, 7, 9), 2000), 0.0, steps=1.0)
    whole = path.read_bytes()
    for length in range(100, len(whole) - 1, 23):
        path.write_bytes(whole[:length])
        with pytest.raises(lm.InputError, match='a.dcm'):
            load(path, i0=4000)
    path.write_bytes(b'none')
    with pytest.raises(lm.InputError, match=r'a.dcm: is not a DICOM file'):
        load(path, i0=4000)


def test_what_dicom_needs(tmp_path, monkeypatch):
    write_xa(tmp_path / 'a.dcm', np.full((2, 7, 9), 2000), 0.0, steps=1.0)
    monkeypatch.setitem(sys.modules, 'pydicom', None)
    with pytest.raises(lm.InputError, match=r"needs the package pydicom: pip install '.\[formats\]'"):
        load(tmp_path / 'a.dcm', i0=4000)


def test_frames_that_do_not_say_where_they_were_taken(tmp_path):
    np.save(tmp_path / 'v.npy', np.ones((2, 3, 4), np.uint16))
    with pytest.raises(lm.InputError, match=r'v.npy: does not say where its frames were taken; give geometry=FILE'):
        load(tmp_path / 'v.npy')
