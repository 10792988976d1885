"""Scans of every kind through `read_scan` and `write_scan`."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import yaml

from helpers.scans import small_dataset
from lingo_mi.common.errors import InputError
from lingo_mi.files import arrays
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.geometry import Geometry
from lingo_mi.geometry.grid import Grid
from lingo_mi.reconstruction import CGLS
from lingo_mi.reconstruction.run import run_algorithm
from lingo_mi.scan import Dataset, Scan


def assert_same_scan(a, b):
    assert vars(a.geometry) | {'angles': 0} == vars(b.geometry) | {'angles': 0}
    np.testing.assert_allclose(a.geometry.angles, b.geometry.angles, rtol=0, atol=1e-14)
    np.testing.assert_allclose(a.projections, b.projections, rtol=3e-7)


def refused(path, match, **options):
    with pytest.raises(InputError, match=match) as caught:
        read_scan(path, **options)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('kind, name', [('naf', 'a.pickle'), ('r2', 'a'), ('exr', 'a'), ('npy', 'a.npy')])
def test_round_trip(tmp_path, kind, name, mode):
    dataset = small_dataset(mode)
    if kind == 'npy':
        dataset = Dataset(dataset.train)
    write_scan(tmp_path / name, dataset, kind)
    back = read_scan(str(tmp_path / name))
    assert_same_scan(back.train, dataset.train)
    if kind == 'npy':
        assert back.test is None and back.volume is None
    else:
        assert_same_scan(back.test, dataset.test)
        np.testing.assert_array_equal(back.volume, dataset.volume)
    assert sorted(p.name for p in tmp_path.iterdir()) == ([name, 'a.yml'] if kind == 'npy' else [name])


@pytest.mark.parametrize('kind, name', [('naf', 'a.pickle'), ('r2', 'a'), ('exr', 'a'), ('npy', 'a.npy')])
def test_a_scan_alone(tmp_path, kind, name):
    scan = small_dataset().train
    write_scan(tmp_path / name, scan.subset([1]), kind)
    back = read_scan(tmp_path / name)
    assert_same_scan(back.train, scan.subset([1]))
    assert back.test is None and back.volume is None


@pytest.mark.parametrize('failing', [0, 1])
def test_an_earlier_scan_stays_whole_where_the_disk_is_full(tmp_path, monkeypatch, failing):
    """Neither the mask nor the geometry of the new scan is left with the old projections."""
    old, calls = small_dataset().train, []
    old = replace(old, valid=np.arange(old.projections.size).reshape(old.projections.shape) > 0)
    write_scan(tmp_path / 'a.npy', old, 'npy')
    before, write = {p.name: p.read_bytes() for p in tmp_path.iterdir()}, arrays.write_npy_in_place

    def full(*args):
        calls.append(args)
        if len(calls) == failing + 1:
            raise OSError(errno.ENOSPC, 'No space left on device')
        write(*args)

    monkeypatch.setattr(arrays, 'write_npy_in_place', full)
    new = replace(
        old, geometry=old.geometry.on(Grid(5, 2.0)), valid=np.flip(old.valid), projections=old.projections + 1
    )
    with pytest.raises(InputError, match='No space left'):
        write_scan(tmp_path / 'a.npy', new, 'npy')
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_write_refuses(tmp_path):
    with pytest.raises(InputError, match='not a kind of scan file'):
        write_scan(tmp_path / 'a', small_dataset(), 'tiff')
    with pytest.raises(InputError, match='ends in .npy'):
        write_scan(tmp_path / 'a', Dataset(small_dataset().train), 'npy')
    with pytest.raises(InputError, match='training views alone'):
        write_scan(tmp_path / 'a.npy', small_dataset(), 'npy')
    s = small_dataset()
    other = Scan(replace(s.test.geometry, DSO=901), s.test.projections)
    for kind in ('naf', 'r2', 'exr'):
        with pytest.raises(InputError, match='one scanner'):
            write_scan(tmp_path / 'a', Dataset(s.train, other), kind)
        with pytest.raises(InputError, match='cannot be written'):
            write_scan(tmp_path / 'none' / 'a', s, kind)
    assert not list(tmp_path.iterdir())
    write_scan(tmp_path / 'a', s, 'exr')
    with pytest.raises(InputError, match='exists already'):
        write_scan(tmp_path / 'a', s, 'exr')


# ---- projections with a geometry file ----------------------------------------------------------------------

GEOMETRY = {
    'DSO': 1000,
    'DSD': 1500,
    'nDetector': [4, 5],
    'dDetector': [2.0, 3.0],
    'nVoxel': [6, 7, 8],
    'sVoxel': [6, 10.5, 16],
    'offOrigin': [1, 2, 3],
    'offDetector': [10, 20],
    'mode': 'cone',
}
PROJECTIONS = np.arange(1.0, 61.0).reshape(3, 4, 5) / 7


def npy(tmp_path, projections=PROJECTIONS, suffix='.yml', **changes):
    np.save(tmp_path / 'scan.npy', projections)
    values = {key: v for key, v in (GEOMETRY | changes).items() if v is not ...}
    (tmp_path / f'scan{suffix}').write_text(yaml.safe_dump(values))
    return tmp_path / 'scan.npy'


@pytest.mark.parametrize('suffix', ['.yml', '.yaml'])
def test_geometry_file_beside(tmp_path, suffix):
    dataset = read_scan(npy(tmp_path, suffix=suffix))
    g = dataset.train.geometry
    assert (g.nDetector, g.dDetector, g.grid.spacing, g.offDetector) == ((4, 5), (2, 3), (1, 1.5, 2), (10, 20))
    np.testing.assert_allclose(np.degrees(g.angles), [0, 120, 240])
    np.testing.assert_array_equal(dataset.train.projections, PROJECTIONS.astype(np.float32))


def test_angles_are_degrees(tmp_path):
    path = npy(tmp_path, angles=[0, 90, -30.5])
    np.testing.assert_allclose(read_scan(path).train.geometry.angles, np.radians([0, 90, -30.5]))
    path = npy(tmp_path, totalAngle=180, startAngle=10)
    np.testing.assert_allclose(read_scan(path).train.geometry.angles, np.radians([10, 70, 130]))


def test_geometry_file_by_name_sizes_and_parallel(tmp_path):
    path = npy(tmp_path, mode='parallel', DSO=..., DSD=..., dDetector=..., sDetector=[8, 15])
    os.replace(tmp_path / 'scan.yml', tmp_path / 'other.yml')
    g = read_scan(path, geometry=tmp_path / 'other.yml').train.geometry
    assert g.mode == 'parallel' and g.dDetector == (2, 3)
    assert 'scan.yml' in refused(path, 'needs its scan geometry')
    refused(path, 'no such file', geometry=tmp_path / 'none.yml')


def test_intensity(tmp_path):
    intensity = 1e4 * np.exp(-PROJECTIONS)
    dataset = read_scan(npy(tmp_path, intensity, input='intensity', I0=1e4))
    np.testing.assert_allclose(dataset.train.projections, PROJECTIONS, rtol=1e-6)
    intensity[1, 2, 3] = np.nan
    np.save(tmp_path / 'mask.npy', np.ones(intensity.shape, bool))
    assert '(1, 2, 3)' in refused(npy(tmp_path, intensity, input='intensity', I0=1e4, valid='mask.npy'), 'not positive')
    intensity[1, 2, 3] = 0
    assert '(1, 2, 3)' in refused(npy(tmp_path, intensity, input='intensity', I0=1e4), 'not positive')


@pytest.mark.parametrize(
    'changes, match',
    [
        ({'DSO': ...}, 'DSO is missing'),
        ({'DSO': 2000}, 'DSD >= DSO'),
        ({'DSD': 1e308}, 'DSD must be finite lengths'),
        ({'DSD': 10**400}, 'DSD must be'),
        ({'angles': [10**400, 0, 0]}, 'angles must be'),
        ({'totalAngle': 10**400}, 'totalAngle must be'),
        ({'dDetector': 1e308}, 'dDetector must be finite lengths'),
        ({'offDetector': [1e300, 0]}, 'offDetector must be finite lengths'),
        ({'offOrigin': [1e300, 0, 0]}, 'offOrigin must be finite lengths'),
        ({'dVoxel': 1e-300, 'sVoxel': ...}, 'lengths of a scan must lie'),
        ({'nVoxel': [10**400, 1, 1]}, 'nVoxel must be'),
        ({'nVoxel': ['x' * 9000, 1, 1]}, 'nVoxel must be'),
        ({'pitch': 1e300}, 'pitch must be finite lengths'),
        ({'pitch': 10**400}, 'pitch must be'),
        ({'tilt': 10**400}, 'tilt must be'),
        ({'mode': [1]}, 'mode must be'),
        ({'nDetector': float('inf')}, 'nDetector must be whole'),
        ({'nVoxel': float('nan')}, 'nVoxel must be whole'),
        ({'offDetector': [[1], [1, 2]]}, 'offDetector must be'),
        ({'DSO': [[1], [1, 2]]}, 'DSO must be'),
        ({'valid': '/etc/hostname'}, 'beside it'),
        ({'valid': '../mask.npy'}, 'beside it'),
        ({'DSO': 'far'}, 'DSO must be'),
        ({'DSO': [1, 2]}, 'DSO must be'),
        ({'nDetector': [5, 4]}, 'shape'),
        ({'nDetector': ...}, 'nDetector is missing'),
        ({'nDetector': [4.5, 5]}, 'whole'),
        ({'dDetector': ...}, 'neither dDetector'),
        ({'dVoxel': [1, 1, 1]}, 'disagree'),
        ({'nVoxel': [0, 7, 8]}, 'nVoxel must be positive'),
        ({'mode': 'fan'}, 'mode must be'),
        ({'mode': 3}, 'mode must be'),
        ({'angles': [1, 2]}, 'these must agree'),
        ({'angles': 'all'}, 'list of numbers'),
        ({'angles': [0, float('nan'), 1]}, 'finite'),
        ({'totalAngle': 'x'}, 'totalAngle must be'),
        ({'offDetector': [1, 2, 3]}, 'must be 2'),
        ({'input': 'counts'}, 'input must be'),
        ({'input': 'intensity'}, 'needs I0'),
        ({'input': 'intensity', 'I0': -1}, 'I0 must be'),
        ({'input': 'intensity', 'I0': 0}, 'I0 must be'),
        ({'rotdetector': [0, 0, 0]}, 'rotdetector is not'),
        ({'offdetector': [0, 0]}, 'offdetector is not'),
    ],
)
def test_bad_geometry_files(tmp_path, changes, match):
    assert str(tmp_path) in refused(npy(tmp_path, **changes), match)


def test_bad_npy_scans(tmp_path):
    for projections, match in (
        (PROJECTIONS[:0], 'non-empty'),
        (PROJECTIONS[0], '3 dimensions'),
        (PROJECTIONS * np.nan, 'NaN'),
        (PROJECTIONS * 1j, 'real numbers'),
    ):
        refused(npy(tmp_path, projections), match)
    path = npy(tmp_path)
    for text, match in (
        ('DSO: [', 'not valid YAML'),
        ('hello', '"name: value"'),
        ('', '"name: value"'),
        ('!!python/object/apply:os.system ["true"]', 'not valid YAML'),
    ):
        (tmp_path / 'scan.yml').write_text(text)
        refused(path, match)
    (tmp_path / 'scan.yml').write_bytes(b'\xff\xfe\x80')
    refused(path, 'not valid YAML')
    refused(tmp_path / 'none.npy', 'no such file')


# ---- EXR folders -------------------------------------------------------------------------------------------


def test_exr_folder_in_detail(tmp_path):
    write_scan(tmp_path / 'a', small_dataset(), 'exr')
    from lingo_mi.files.images import read_exr

    np.testing.assert_array_equal(read_exr(tmp_path / 'a' / 'train' / '0002.exr'), small_dataset().train.projections[2])
    assert sorted(p.name for p in (tmp_path / 'a').iterdir()) == ['geometry.yml', 'test', 'train', 'volume.nii.gz']
    values = yaml.safe_load((tmp_path / 'a' / 'geometry.yml').read_text())
    np.testing.assert_allclose(values['test_angles'], np.degrees([3.0, 0.1]))


def test_bad_exr_folders(tmp_path):
    from lingo_mi.files.images import write_exr

    write_scan(tmp_path / 'a', small_dataset(), 'exr')
    folder = tmp_path / 'a'
    last = folder / 'train' / '0002.exr'
    raw = last.read_bytes()
    last.write_bytes(raw[:100])
    assert '0002.exr' in refused(folder, 'damaged')
    write_exr(last, np.ones((6, 4)))
    assert '0002.exr' in refused(folder, 'one panel')
    last.unlink()
    refused(folder, 'these must agree')
    last.write_bytes(raw)
    text = (folder / 'geometry.yml').read_text()
    (folder / 'geometry.yml').write_text('\n'.join(line for line in text.splitlines() if 'test_angles' not in line))
    refused(folder, 'test_angles is missing')
    (folder / 'geometry.yml').write_text(text)
    for file in (folder / 'train').iterdir():
        file.unlink()
    refused(folder, 'holds no .exr views')
    (folder / 'geometry.yml').unlink()
    refused(folder, 'neither meta_data.json')


# ---- any path ----------------------------------------------------------------------------------------------


def test_unknown_paths(tmp_path):
    refused(tmp_path, 'neither meta_data.json')
    refused(tmp_path / 'none', 'no such file')
    (tmp_path / 'a.xyz').touch()
    refused(tmp_path / 'a.xyz', 'not a known scan format')
    for name in 'frames.tif', 'scan.nxs', 'folder/0001.EDF':
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
        path = tmp_path / name.partition('/')[0]
        refused(path, f'lingo-mi import {path} --geometry')
    refused(tmp_path / 'a.xyz', 'carries its own geometry', geometry='g.yml')


# ---- Helsinki Tomography Challenge -------------------------------------------------------------------------


def htc(tmp_path, **changes):
    data = {
        'sinogram_ta': np.arange(30.0).reshape(5, 6),
        'angles_deg': np.array([0, 90, 180, 270, 360.0]),
        'DSO': 410.66,
        'DSD': 553.74,
        'dDetector': 0.2,
    } | changes
    np.savez(tmp_path / 'htc.npz', **{key: v for key, v in data.items() if v is not ...})
    return tmp_path / 'htc.npz'


def test_htc_geometry(tmp_path):
    scan = read_scan(htc(tmp_path)).train
    g = scan.geometry
    assert (g.nDetector, g.dDetector) == ((1, 6), (0.2, 0.2))
    assert (g.grid.shape, g.grid.spacing) == ((512, 512, 1), (0.1483,) * 3)
    # the last of their angles repeats the first
    np.testing.assert_allclose(np.degrees(g.angles), [-90, 0, 90, 180])
    np.testing.assert_array_equal(scan.projections[:, 0], np.arange(24).reshape(4, 6))
    # theirs: source DSO (sin a, -cos a, 0), columns along (cos a, sin a)
    frames = g.rays()
    np.testing.assert_allclose(frames.source[1], [410.66, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frames.u[0] / 0.2, [1, 0, 0], atol=1e-12)


def test_htc_choice_and_bad_input(tmp_path):
    path = htc(tmp_path, sinogram_01a=np.ones((5, 6)))
    assert read_scan(path, name='01a').train.projections.max() == 1
    assert '01a, ta' in refused(path, 'no sinogram', name='09b')
    for changes, match in (
        ({'DSO': ...}, 'not a scan of'),
        ({'sinogram_ta': ...}, 'not a scan of'),
        ({'angles_deg': np.arange(4.0)}, 'must agree'),
        ({'sinogram_ta': np.ones(6)}, '2 dimensions'),
        ({'sinogram_ta': np.full((5, 6), np.nan)}, 'NaN'),
        ({'DSO': 600.0}, 'DSD >= DSO'),
        ({'dDetector': 'a'}, 'must be numbers'),
    ):
        assert 'htc.npz' in refused(htc(tmp_path, **changes), match)


def walnut(tmp_path, **changes):
    data = {
        'projections': np.arange(120, dtype=np.float16).reshape(4, 5, 6),
        'angles': np.array([0, -90, -180, -270.0]),
        'DSO': 210.66,
        'DSD': 553.74,
        'dDetector': np.array([0.4, 0.5]),
        'air': np.float32(0.5),
        'source': 'a walnut',
    } | changes
    np.savez(tmp_path / 'walnut.npz', **{key: v for key, v in data.items() if v is not ...})
    return tmp_path / 'walnut.npz'


def test_walnut_geometry(tmp_path):
    scan = read_scan(walnut(tmp_path)).train
    g, rays = scan.geometry, scan.geometry.rays()
    assert (g.nDetector, g.dDetector, g.grid.shape, g.grid.spacing) == ((5, 6), (0.4, 0.5), (128,) * 3, (0.305,) * 3)
    # theirs: source DSO (-sin a, cos a, 0), columns along (cos a, sin a), which are turned round here
    for view, a in enumerate(np.radians([0, -90, -180, -270])):
        np.testing.assert_allclose(rays.source[view], 210.66 * np.array([-np.sin(a), np.cos(a), 0]), atol=1e-9)
        np.testing.assert_allclose(rays.u[view] / 0.5, [-np.cos(a), -np.sin(a), 0], atol=1e-12)
        assert rays.v[view][2] < 0  # row 0 is the top
    np.testing.assert_array_equal(scan.projections, np.arange(120.0).reshape(4, 5, 6)[:, :, ::-1] - 0.5)


def test_bad_walnuts(tmp_path):
    for changes, match in (
        ({'air': ...}, 'the only .npz scans'),
        ({'projections': ...}, 'the only .npz scans'),
        ({'angles': np.arange(5.0)}, 'must agree'),
        ({'projections': np.ones((4, 5))}, '3 dimensions'),
        ({'projections': np.full((4, 5, 6), np.nan)}, 'NaN'),
        ({'air': np.ones(2)}, 'one number'),
        ({'air': np.float32('nan')}, 'NaN'),
        ({'DSO': 600.0}, 'DSD >= DSO'),
        ({'dDetector': 'a'}, 'must be numbers'),
    ):
        assert 'walnut.npz' in refused(walnut(tmp_path, **changes), match)


def test_the_voxels_of_a_scene_are_used_with_measured_projections(tmp_path):
    path = walnut(tmp_path)
    for options, count, size in (
        (dict(nVoxel='7, 8, 9', dVoxel='2'), (7, 8, 9), (2.0,) * 3),
        (dict(dVoxel='1, 2, 3'), (128,) * 3, (1.0, 2.0, 3.0)),
        ({}, (128,) * 3, (0.305,) * 3),
    ):
        scanner = mi.load_dict({'type': 'ct_scanner', 'projections': str(path), **options})
        assert (scanner.geometry.grid.shape, scanner.geometry.grid.spacing) == (count, size)
        assert scanner.dataset.train.geometry is scanner.geometry


def test_measured_walnut(data):
    """A volume meets the views where they turn as stated, and not where they turn the other way."""
    path = data / 'walnut_cone.npz'
    if not path.exists():
        pytest.skip('LINGO_MI_DATA names no folder with walnut_cone.npz')
    scan = read_scan(path).train
    scan = Scan(scan.geometry.binned(4), scan.projections.reshape(120, 64, 4, 64, 4).mean((2, 4))).subset(
        range(0, 120, 3)
    )
    scan = scan.on(Grid(64, 0.61, scan.geometry.grid.centre))
    other = replace(scan, geometry=replace(scan.geometry, angles=-scan.geometry.angles))
    residual, wrong = (run_algorithm(s, CGLS(niter=8)).residuals[-1] for s in (scan, other))
    assert residual < 0.05 and wrong > 1.5 * residual


def fan_fbp(scan, n, size):
    """Filtered back-projection of a full fan-beam scan on n x n pixels of `size` mm: [x, y], per mm."""
    g, frames = scan.geometry, scan.geometry.rays()
    pitch = g.dDetector[1] * g.DSO / g.DSD  # of the panel moved to the axis
    s = (np.arange(g.nDetector[1]) + 0.5 - g.nDetector[1] / 2) * pitch
    p = scan.projections[:, 0] * (g.DSO / np.hypot(g.DSO, s))
    k = np.fft.fftfreq(2048) * 2048  # the ramp of Kak and Slaney, sampled in space
    ramp = np.where(k == 0, 1 / (8 * pitch**2), 0.0)
    odd = k % 2 == 1
    ramp[odd] = -1 / (2 * np.pi**2 * k[odd] ** 2 * pitch**2)
    p = np.fft.ifft(np.fft.fft(p, 2048) * np.fft.fft(ramp)).real[:, : p.shape[1]] * pitch
    c = (np.arange(n) + 0.5 - n / 2) * size
    x, y = (a.ravel() for a in np.meshgrid(c, c, indexing='ij'))
    points = np.stack([x, y, 0 * x], 1)
    image = np.zeros(n * n)
    for view, angle in enumerate(g.angles):
        column = frames.project(points, view)[0] - 0.5
        depth = g.DSO - x * np.cos(angle) - y * np.sin(angle)
        image += (g.DSO / depth) ** 2 * np.interp(column, np.arange(p.shape[1]), p[view], left=0, right=0)
    return image.reshape(n, n) * 2 * np.pi / len(scan)


def test_htc_reconstruction_agrees_with_the_challenges():
    """The measured disc, back-projected along our rays, is the challenge's own image: the geometry's
    conventions are right."""
    folder = os.environ.get('LINGO_MI_DATA')
    if not folder or not (Path(folder) / 'htc2022_fan.npz').exists():
        pytest.skip('LINGO_MI_DATA names no folder with htc2022_fan.npz')
    path = Path(folder) / 'htc2022_fan.npz'
    scan = read_scan(path).train
    assert len(scan) == 720
    image = fan_fbp(scan.subset(np.arange(0, 720, 2)), 256, 2 * 0.1483)
    reference = np.load(path)['fbp_ta'].reshape(256, 2, 256, 2).mean((1, 3))

    def correlation(a, b):
        return np.corrcoef(a.ravel(), b.ravel())[0, 1]

    assert correlation(image.T[::-1], reference) >= 0.99  # rows of the reference run along -y
    assert correlation(image.T, reference) < 0.9 and correlation(image, reference) < 0.9
    # the reference is per pixel of 0.1483 mm
    assert np.polyfit(reference.ravel() / 0.1483, image.T[::-1].ravel(), 1)[0] == pytest.approx(1, abs=0.05)


def test_exr_views_are_read_in_the_order_of_their_numbers(tmp_path):
    scan = small_dataset().train
    scan = scan.subset(np.arange(12) % len(scan))
    scan = replace(scan, projections=np.arange(12, dtype=np.float32)[:, None, None] + np.zeros(scan.projections.shape))
    write_scan(tmp_path / 'a', scan, 'exr')
    for i in range(12):
        (tmp_path / f'a/train/{i:04d}.exr').rename(tmp_path / f'a/train/{i}.exr')
    assert read_scan(tmp_path / 'a').train.projections[:, 0, 0].tolist() == list(range(12))


def test_many_poses_have_a_file_of_their_own(tmp_path):
    angles = np.linspace(0, 40, 1200)
    sizes = dict(DSO=100, DSD=150, nDetector=2, dDetector=1.0, nVoxel=4, dVoxel=1.0)
    scan = Scan(Geometry.helix(angles=angles, pitch=5.0, **sizes), np.ones((1200, 2, 2)))
    write_scan(tmp_path / 'a.npy', scan, 'npy')
    assert sorted(p.name for p in tmp_path.iterdir()) == ['a.npy', 'a.poses.npy', 'a.yml']
    back = read_scan(tmp_path / 'a.npy').train.geometry.rays()
    np.testing.assert_allclose(back.corner, scan.geometry.rays().corner, atol=1e-9)


def test_held_out_views_of_an_npy_are_refused(tmp_path):
    write_scan(tmp_path / 'a.npy', small_dataset().train, 'npy')
    with open(tmp_path / 'a.yml', 'a') as file:
        file.write('test_angles: [1, 2]\n')
    refused(tmp_path / 'a.npy', 'test_angles goes with a folder of EXR views')


def test_more_exr_views_than_memory_holds(tmp_path, monkeypatch):
    write_scan(tmp_path / 'scan', small_dataset(), 'exr')
    monkeypatch.setattr('lingo_mi.common.memory.host_room', lambda: 100.0)
    with pytest.raises(InputError, match='memory'):
        read_scan(tmp_path / 'scan')


def test_numbers_that_yaml_takes_for_text(tmp_path):
    write_scan(tmp_path / 'a.npy', small_dataset().train, 'npy')
    text = (tmp_path / 'a.yml').read_text().replace('input: line_integral', 'input: intensity\nI0: 1e3')
    (tmp_path / 'a.yml').write_text(text)
    np.save(tmp_path / 'a.npy', np.full(small_dataset().train.projections.shape, 1e3 * np.exp(-1), np.float32))
    np.testing.assert_allclose(read_scan(tmp_path / 'a.npy').train.projections, 1, rtol=1e-6)
