"""Poses in the conventions of RTK, ASTRA and projection matrices: by hand, round trips, through scans and scenes."""

from dataclasses import replace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import yaml

from helpers.circles import circle
from helpers.poses import to_matrices
from lingo_mi.common.errors import InputError
from lingo_mi.files.poses import read_poses
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.geometry import CircularGeometry, Geometry, PosedGeometry, astra, matrices, rtk
from lingo_mi.geometry.rays import Rays
from lingo_mi.geometry.trajectories import helix, rotation
from lingo_mi.scan import Dataset, Scan

SHAPE, STEP = (20, 24), (1.5, 2.0)
GRID = dict(nVoxel=(5, 6, 7), dVoxel=(1.0, 2.0, 3.0))
POINTS = np.random.default_rng(0).uniform(-15, 15, (20, 3))


def scan_of(mode='cone', **changes):
    """Three views that leave the circle in every way (a parallel beam's panel stays across it)."""
    motion = dict(
        height=[1.0, 5.0, -4.0],
        tilt=[0.1, 0.2, -0.3],
        COR=2.0,
        offDetector=[[4.0, -5.0], [3.0, 2.0], [0.0, 1.0]],
        rotDetector=(0.0, 0.0, 0.1) if mode == 'parallel' else (0.05, -0.04, 0.1),
    )
    return Geometry.per_view(
        **{
            **dict(
                DSO=[900.0, 905.0, 910.0],
                DSD=1400.0,
                nDetector=SHAPE,
                dDetector=STEP,
                mode=mode,
                angles=[0.1, 0.7, 3.0],
                offOrigin=(1.0, -2.0, 3.0),
                **GRID,
            ),
            **motion,
            **changes,
        }
    )


def pixels(frames):
    return np.array([frames.project(POINTS, view) for view in range(len(frames))])


def same_poses(a, b, tolerance=1e-9):
    assert a.parallel == b.parallel
    for x, y in ((a.source, b.source), (a.corner, b.corner), (a.u, b.u), (a.v, b.v)):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance)


# ---- round trips -------------------------------------------------------------------------------------------


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_round_trips(tmp_path, mode):
    f = scan_of(mode).rays()
    parallel = mode == 'parallel'
    same_poses(astra.from_vectors(astra.to_vectors(f, SHAPE), SHAPE, parallel), f)
    back = matrices.from_matrices(to_matrices(f) * -3.0, SHAPE, STEP, parallel)
    np.testing.assert_allclose(pixels(back), pixels(f), atol=1e-9)
    if not parallel:  # the panel of a parallel beam may stand anywhere along it
        same_poses(back, f)
    rtk.write_rtk(tmp_path / 'g.xml', f, SHAPE)
    back = rtk.read_rtk(tmp_path / 'g.xml', SHAPE, STEP)
    np.testing.assert_allclose(pixels(back), pixels(f), atol=1e-9)
    if not parallel:
        same_poses(back, f)


@pytest.mark.parametrize('name', ['p.npy', 'p.txt', 'p.csv', 'm.npy', 'g.xml'])
def test_files_of_poses(tmp_path, name):
    f = scan_of().rays()
    path, vectors = tmp_path / name, astra.to_vectors(f, SHAPE)
    if name == 'g.xml':
        rtk.write_rtk(path, f, SHAPE)
    elif name == 'm.npy':
        np.save(path, to_matrices(f))
    elif name == 'p.npy':
        np.save(path, vectors)
    else:
        np.savetxt(path, vectors, delimiter=',' if name == 'p.csv' else ' ', header='source, centre, u, v')
    same_poses(read_poses(path, SHAPE, STEP), f)


# ---- conventions by hand -----------------------------------------------------------------------------------


def test_astra_vectors_by_hand():
    """ASTRA's cone geometry at the angle 0 has its source at -y, columns along x, and rows along z."""
    vector = [0, -300, 0, 0, 150, 0, 2, 0, 0, 0, 0, 1.5]
    f = astra.from_vectors([vector], SHAPE, False)
    x, y = f.project([[10.0, 0.0, 4.0], [0.0, 100.0, 0.0]], 0)
    np.testing.assert_allclose(x, [12 + 1.5 * 10 / 2, 12])
    np.testing.assert_allclose(y, [10 + 1.5 * 4 / 1.5, 10])
    g = Geometry.from_poses(f, SHAPE, **GRID)
    assert isinstance(g, PosedGeometry) and (g.DSO, g.DSD) == (300, 450)  # its rows run up: not this package's circle


def test_matrices_by_hand():
    """K [R | t] of a camera 300 mm from the axis, 45 degrees round; the pixels' centres are whole numbers."""
    K = np.array([[225.0, 0, 11.5], [0, 300.0, 9.5], [0, 0, 1]])  # 450 / 2, 450 / 1.5; the middle of 24 x 20 pixels
    c = np.sqrt(0.5)
    R = np.array([[-c, c, 0], [0, 0, -1], [-c, -c, 0]])  # right, down, forward of a camera at (c, c, 0)
    P = K @ np.column_stack([R, [0, 0, 300.0]])
    one = circle(DSO=300.0, DSD=450.0, nDetector=SHAPE, dDetector=STEP, **GRID, angles=[np.pi / 4])
    for sign in (1, -1):
        same_poses(matrices.from_matrices([sign * P], SHAPE, STEP, False), one.rays())
    np.testing.assert_allclose(to_matrices(one.rays())[0] * 450, P, atol=1e-9)


@pytest.mark.parametrize('step', [0.01, 1.0, 100.0])
def test_a_matrix_is_parallel_to_rounding(step):
    """The last row counts as zero relative to the other rows' largest entry, which is one over the pixel's size."""
    g = circle(DSO=0.0, DSD=0.0, nDetector=SHAPE, dDetector=step, **GRID, angles=[0.0], mode='parallel')
    P = to_matrices(g.rays())
    P[0, 2, 0] = 0.5e-9 / step
    same_poses(matrices.from_matrices(P, SHAPE, (step, step), True), g.rays(), 1e-7 * step)
    P[0, 2, 0] = 2e-9 / step
    with pytest.raises(InputError, match='not belong to a parallel beam'):
        matrices.from_matrices(P, SHAPE, (step, step), True)


# Written by RTK 2.7: AddProjection(1000, 1500, gantry, 4, -7, 5, 8, 2, 3) for 30 and 70 degrees, and a parallel beam. Its
# matrices take RTK's (x, y, z, 1) to millimetres on the panel.
RTK = """<?xml version="1.0"?>
<!DOCTYPE RTKGEOMETRY>
<RTKThreeDCircularGeometry version="3">
    <SourceToIsocenterDistance>1000</SourceToIsocenterDistance>
    <SourceToDetectorDistance>1500</SourceToDetectorDistance>
    <SourceOffsetX>2</SourceOffsetX>
    <SourceOffsetY>3</SourceOffsetY>
    <ProjectionOffsetX>4</ProjectionOffsetX>
    <ProjectionOffsetY>-7</ProjectionOffsetY>
    <InPlaneAngle>8</InPlaneAngle>
    <OutOfPlaneAngle>5</OutOfPlaneAngle>
  <Projection>
    <GantryAngle>30</GantryAngle>
    <Matrix>
        -1296.48945206673   -207.790946454611    725.218603768007                5000
         121.041473134923   -1480.62125708233   -207.869321587526               -5500
        0.498097349045873 -0.0871557427476582   0.862729915662821               -1000
    </Matrix>
  </Projection>
  <Projection>
    <GantryAngle>70</GantryAngle>
    <CollimationUInf>1.79769313486232e+308</CollimationUInf>
    <Matrix>
        -527.007007501837   -207.790946454611    1388.91703734077                5000
        -40.8926764684658   -1480.62125708233   -237.041097886371               -5500
        0.936116806662859 -0.0871557427476582    0.34071865342161               -1000
    </Matrix>
  </Projection>
</RTKThreeDCircularGeometry>
"""
RTK_MATRICES = [
    [
        [-1296.48945206673, -207.790946454611, 725.218603768007, 5000],
        [121.041473134923, -1480.62125708233, -207.869321587526, -5500],
        [0.498097349045873, -0.0871557427476582, 0.862729915662821, -1000],
    ],
    [
        [-527.007007501837, -207.790946454611, 1388.91703734077, 5000],
        [-40.8926764684658, -1480.62125708233, -237.041097886371, -5500],
        [0.936116806662859, -0.0871557427476582, 0.34071865342161, -1000],
    ],
]
RTK_PARALLEL = [
    [0.86366217157909, 0.138643505293404, -0.484629375732889, -4],
    [-0.0773736664296428, 0.986499799769905, 0.144331080496103, 7],
    [0, 0, 0, 1],
]


def rtk_file(tmp_path, parallel=False):
    path = tmp_path / 'rtk.xml'
    path.write_text(RTK.replace('<SourceToDetectorDistance>1500</SourceToDetectorDistance>', '') if parallel else RTK)
    return path


@pytest.mark.parametrize('parallel', [False, True])
def test_rtks_own_file(tmp_path, parallel):
    f = rtk.read_rtk(rtk_file(tmp_path, parallel), SHAPE, STEP)
    assert f.parallel == parallel and len(f) == 2
    for view, matrix in enumerate([RTK_PARALLEL] if parallel else RTK_MATRICES):
        a, b, w = np.array(matrix) @ np.concatenate([POINTS[:, [1, 2, 0]], np.ones((20, 1))], 1).T
        x, y = f.project(POINTS, view)
        np.testing.assert_allclose((x - 12) * 2, a / w, atol=1e-9)
        np.testing.assert_allclose((10 - y) * 1.5, b / w, atol=1e-9)  # its rows run up


def test_matrices_in_the_file_for_rtk(tmp_path):
    """RTK refuses a file whose matrices are not its own."""
    f = rtk.read_rtk(rtk_file(tmp_path), SHAPE, STEP)
    rtk.write_rtk(tmp_path / 'again.xml', f, SHAPE)
    text = (tmp_path / 'again.xml').read_text()
    parts = [part.split('</Matrix>')[0].split() for part in text.split('<Matrix>')[1:]]
    read = [np.reshape([float(x) for x in part], (3, 4)) for part in parts]
    np.testing.assert_allclose(read, RTK_MATRICES, rtol=1e-11, atol=1e-9)
    one = circle(
        DSO=300.0, DSD=450.0, nDetector=SHAPE, dDetector=STEP, **GRID, angles=[0.3, 1.0], offDetector=(3.0, -4.0)
    )
    rtk.write_rtk(tmp_path / 'circle.xml', one.rays(), SHAPE)
    same = Geometry.from_poses(read_poses(tmp_path / 'circle.xml', SHAPE, STEP), SHAPE, **GRID)
    assert isinstance(same, CircularGeometry)
    np.testing.assert_allclose(
        [same.DSO, same.DSD, *same.offDetector, *same.angles], [300, 450, 3, -4, 0.3, 1.0], rtol=1e-12
    )


# ---- scans on disk -----------------------------------------------------------------------------------------


def projections(n=3):
    return np.random.default_rng(1).random((n, *SHAPE)).astype(np.float32)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('kind, name', [('npy', 'a.npy'), ('exr', 'a')])
def test_scans_keep_their_poses(tmp_path, kind, name, mode):
    g = scan_of(mode)
    train, test = Scan(g, projections()), Scan(g.subset([2, 0]), projections(2))
    write_scan(tmp_path / name, train if kind == 'npy' else Dataset(train, test), kind)
    back = read_scan(tmp_path / name)
    for a, b in ((back.train, train), (back.test, test))[: 1 if kind == 'npy' else 2]:
        same_poses(a.geometry.rays(), b.geometry.rays())
        assert all(getattr(a.geometry, k) == getattr(b.geometry, k) for k in ('grid', 'nDetector', 'mode'))
        np.testing.assert_array_equal(a.projections, b.projections)


@pytest.mark.parametrize('kind', ['naf', 'r2'])
def test_formats_of_circles_refuse_other_poses(tmp_path, kind):
    with pytest.raises(InputError, match='circular scans only'):
        write_scan(tmp_path / 'a', Scan(scan_of(), projections()), kind)
    assert not list(tmp_path.iterdir())


def npy(tmp_path, **values):
    np.save(tmp_path / 'scan.npy', projections())
    numbers = {
        'nDetector': list(SHAPE),
        'dDetector': list(STEP),
        'nVoxel': [5, 6, 7],
        'dVoxel': [1.0, 2.0, 3.0],
    } | values
    (tmp_path / 'scan.yml').write_text(yaml.safe_dump({k: v for k, v in numbers.items() if v is not ...}))
    return tmp_path / 'scan.npy'


def test_tigres_numbers_in_yaml(tmp_path):
    path = npy(
        tmp_path,
        DSO=[900, 905, 910],
        DSD=1400,
        angles=[10, 20, 300],
        offDetector=[[4, -5], [3, 2], [0, 1]],
        rotDetector=[1, 2, 3],
        COR=2,
        tilt=[5, 6, 7],
        z=[1, 5, -4],
    )
    expected = scan_of(
        DSO=[900, 905, 910],
        angles=np.radians([10, 20, 300]),
        rotDetector=np.radians([1, 2, 3]),
        tilt=np.radians([5, 6, 7]),
        offOrigin=(0, 0, 0),
    )
    same_poses(read_scan(path).train.geometry.rays(), expected.rays())
    path = npy(tmp_path, DSO=900, DSD=1400, totalAngle=720, startAngle=-360, pitch=30)
    f = read_scan(path).train.geometry.rays()
    np.testing.assert_allclose(f.source[:, 2], [-30, -10, 10])
    np.testing.assert_allclose(
        f.source[1], 900 * np.array([np.cos(np.radians(-120)), np.sin(np.radians(-120)), -1 / 90])
    )
    path = npy(tmp_path, DSO=900, DSD=1400, angles=[[10, 20, 30], [40, 50, 60], [70, 80, 90]], mode='parallel')
    f = read_scan(path).train.geometry.rays()
    turn = rotation('z', np.radians(40)) @ rotation('y', np.radians(50)) @ rotation('z', np.radians(60))
    np.testing.assert_allclose(f.source[1], -turn[0, :, 0], atol=1e-12)


def test_poses_in_yaml(tmp_path):
    f = scan_of().rays()
    same_poses(
        read_scan(npy(tmp_path, poses=astra.to_vectors(f, SHAPE).tolist(), dDetector=...)).train.geometry.rays(), f
    )
    np.save(tmp_path / 'matrices.npy', to_matrices(f))
    same_poses(read_scan(npy(tmp_path, poses='matrices.npy')).train.geometry.rays(), f)
    # Rows of RTK's images run up: the poses are given with the rows down, and the array is turned round to match.
    rtk.write_rtk(tmp_path / 'g.xml', f, SHAPE)
    scan = read_scan(npy(tmp_path, poses='g.xml')).train
    same_poses(scan.geometry.rays(), f)
    np.testing.assert_array_equal(scan.projections, projections()[:, ::-1])


# ---- scenes ------------------------------------------------------------------------------------------------


def scanner(**values):
    return mi.load_dict(dict(type='ct_scanner', nDetector='20, 24', nVoxel='5, 6, 7', dVoxel='1, 2, 3', **values))


def test_moving_scanners_in_scenes(tmp_path):
    plain = dict(DSO=900, DSD=1400, dDetector='1.5, 2', angles='-80, 10, 400')
    angles = np.radians([-80, 10, 400])
    sensor = scanner(**plain, pitch=30.0, tilt=5.0, rotDetector='1, 2, 3', test_views=4)
    like = dict(
        DSO=900.0,
        DSD=1400.0,
        nDetector=SHAPE,
        dDetector=STEP,
        **GRID,
        tilt=np.radians(5),
        rotDetector=np.radians([1, 2, 3]),
    )
    same_poses(sensor.geometry.rays(), Geometry.per_view(**like, angles=angles, height=helix(angles, 30.0)).rays())
    held_out = np.radians(np.sort(np.random.default_rng(0).uniform(-80, 400, 4)))  # between the first and the last
    same_poses(
        sensor.test_geometry.rays(), Geometry.per_view(**like, angles=held_out, height=helix(held_out, 30.0)).rays()
    )
    assert isinstance(scanner(**plain).geometry, CircularGeometry)
    # A view of it is a sensor with the same poses, by its description.
    view = sensor.view(2)
    same_poses(view.geometry.rays(), sensor.geometry.rays())
    np.testing.assert_allclose(np.ravel(view.frame.corner), sensor.geometry.rays().corner[2], atol=1e-9)
    assert 'a pose a view' in str(sensor)


def test_files_of_poses_in_scenes(tmp_path, monkeypatch):
    monkeypatch.setenv('LINGO_MI_DATA', str(tmp_path))
    f = scan_of().rays()
    rtk.write_rtk(tmp_path / 'g.xml', f, SHAPE)
    same_poses(scanner(poses='g.xml', dDetector='1.5, 2').geometry.rays(), f)
    np.savetxt(tmp_path / 'p.txt', astra.to_vectors(f, SHAPE))
    same_poses(scanner(poses='p.txt').geometry.rays(), f)
    p = scan_of('parallel').rays()
    np.savetxt(tmp_path / 'p.txt', astra.to_vectors(p, SHAPE))
    same_poses(scanner(poses='p.txt', mode='parallel').geometry.rays(), p)


@pytest.mark.parametrize(
    'values, match',
    [
        (dict(poses='1 2 3'), '12 numbers for every view, not 3'),
        (dict(poses='none.npy'), 'no such file'),
        (dict(poses='0 0 0 0 0 0 0 0 0 0 0 0'), 'view 0 has steps'),
        (dict(poses='1 2 3', DSO=3.0), 'DSO and poses both'),
        (dict(DSO=9.0, DSD=14.0, dDetector='1', rotDetector='1, 2'), 'rotDetector must be 3'),
        (dict(DSO=9.0, DSD=14.0, dDetector='1', tilt='steep'), 'tilt must be a number'),
        (dict(DSO=9.0, DSD=14.0, dDetector='1', pitch=float('inf')), 'pitch must be a number'),
    ],
)
def test_bad_scanners(values, match):
    with pytest.raises(Exception, match=match):
        scanner(**values)


# ---- bad files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'name, content, match',
    [
        ('a.mat', '', 'not a known file of poses'),
        ('a.txt', '1 2 x', 'not a table'),
        ('a.txt', '1 2\n3', 'not a table'),
        ('a.txt', '1 2 3', '12 numbers for every view'),
        ('a.npy', 'no', 'damaged'),
        ('a.xml', '<a', 'is not XML'),
        ('a.xml', '<a/>', 'is not RTKThreeD'),
        ('a.xml', '<RTKThreeDCircularGeometry version="3"/>', 'no projections'),
        ('a.xml', RTK.replace('>30<', '>east<'), 'GantryAngle must be a finite number'),
        (
            'a.xml',
            RTK.replace('<Proj', '<RadiusCylindricalDetector>9</RadiusCylindricalDetector><Proj', 1),
            'must be one of less than 180',
        ),
        (
            'a.xml',
            RTK.replace(
                '>30<', '>30</GantryAngle><SourceToDetectorDistance>0</SourceToDetectorDistance><GantryAngle>30<'
            ),
            'mixes parallel and cone',
        ),
    ],
)
def test_bad_files_of_poses(tmp_path, name, content, match):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=match) as caught:
        read_poses(tmp_path / name, SHAPE, STEP)
    assert '\n' not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_bad_matrices(tmp_path):
    P = to_matrices(scan_of().rays())
    for bad, parallel, match in (
        (P[:, :2], False, r'\[view, 3, 4\]'),
        (P * np.nan, False, 'NaN'),
        (P * [[1], [1], [0]], False, 'view 0 does not belong to a cone'),
        (P, True, 'view 0 does not belong to a parallel'),
        (P * [[1], [0], [0]] + [0, 0, 0, 1.0], True, 'along one direction'),
    ):
        with pytest.raises(InputError, match=match):
            matrices.from_matrices(bad, SHAPE, STEP, parallel)
    np.save(tmp_path / 'm.npy', P)
    with pytest.raises(InputError, match='add dDetector'):
        read_poses(tmp_path / 'm.npy', SHAPE)


def test_what_rtk_cannot_say(tmp_path):
    f, path = scan_of().rays(), tmp_path / 'g.xml'
    tilted = scan_of('parallel', rotDetector=(0.1, 0.0, 0.0)).rays()
    # A source in the panel: the distance of 0 would say that the beam is parallel.
    corner = np.array([[0.0, -SHAPE[1] / 2, SHAPE[0] / 2]])
    within = Rays(np.zeros((1, 3)), corner, np.array([[0.0, 1, 0]]), np.array([[0.0, 0, -1]]), False)
    for bad, match in (
        (replace(f, u=f.u + 0.1 * f.v), 'right angles'),
        (replace(f, u=f.u * [[1], [1], [1.1]]), 'one pixel size'),
        (replace(f, u=-f.u), 'mirrored'),
        (within, 'mirrored'),
        (tilted, 'askew'),
    ):
        with pytest.raises(InputError, match=match):
            rtk.write_rtk(path, bad, SHAPE)
    assert not path.exists()


@pytest.mark.parametrize(
    'changes, match',
    [
        (dict(poses=[[1, 2, 3]]), '12 numbers'),
        (dict(poses='gone.txt'), 'no such file'),
        (dict(poses=[[0.0, 0, 900, 0, 0, 0, 1, 0, 0, 0, 1, 0]]), 'are 1 views, but there are 3'),
        (dict(poses='gone.txt', DSO=900), 'DSO and poses both'),
        (dict(DSO=[900, 905], DSD=1400), 'DSO must be 1 number'),
        (dict(DSO=900, DSD=1400, pitch=3, z=[1, 2, 3]), 'pitch and z both'),
        (dict(DSO=900, DSD=1400, tilt='steep'), 'tilt must be'),
        (dict(DSO=900, DSD=1400, rotDetector=[[1, 2, 3], [1, 2, 3]]), 'rotDetector must be 3 numbers'),
        (dict(DSO=900, DSD=[1400, 800, 1400], tilt=1), 'DSD >= DSO'),
    ],
)
def test_bad_poses_in_yaml(tmp_path, changes, match):
    path = npy(tmp_path, **changes)
    with pytest.raises(InputError, match=match) as caught:
        read_scan(path)
    assert '\n' not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_what_rtk_calls_its_numbers(tmp_path):
    """RTK's reader looks for these names, and takes absent ones for zero."""
    rtk.write_rtk(tmp_path / 'g.xml', scan_of().rays(), SHAPE)
    (shared, *views) = ElementTree.parse(tmp_path / 'g.xml').getroot().iter()
    names = {e.tag for e in (shared, *views)}
    expected = {
        'RTKThreeDCircularGeometry',
        'Projection',
        'Matrix',
        *('SourceToIsocenterDistance', 'SourceToDetectorDistance', 'GantryAngle', 'OutOfPlaneAngle', 'InPlaneAngle'),
        *('ProjectionOffsetX', 'ProjectionOffsetY', 'SourceOffsetX', 'SourceOffsetY'),
    }
    assert names == expected
