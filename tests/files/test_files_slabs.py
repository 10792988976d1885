"""Volumes written slab by slab: the same files as for the whole volume, and volumes that agree to float32's last digits."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm
from helpers.script import FIT, SCENE, run
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import write_scan
from lingo_mi.files.slabs import write_slabs
from lingo_mi.files.volumes import read_volume, write_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.reconstruction.run import run_algorithm

RECONSTRUCT = FIT.with_name('reconstruct.py')


def geometry(shape, spacing=(1.0, 1.5, 2.0), origin=(3.0, -4.0, 5.0)):
    return lm.Geometry.cone(
        DSO=300,
        DSD=450,
        nDetector=(40, 48),
        dDetector=4.0,
        nVoxel=shape,
        dVoxel=spacing,
        offOrigin=origin,
        angles=np.linspace(0, 6, 9),
    )


def noise(shape):
    return np.random.default_rng(0).random(shape, np.float32)


def slabs(volume, thickness):
    return (volume[:, :, z : z + thickness] for z in range(0, volume.shape[2], thickness))


@pytest.mark.parametrize('name', ['v.nii', 'v.nii.gz'])
def test_nifti(tmp_path, name):
    """The file is the whole volume's, byte for byte, except for the name and the time that gzip keeps."""
    g, v = geometry((7, 6, 11)), noise((7, 6, 11))
    write_slabs(tmp_path / name, g.grid, slabs(v, 4))
    write_volume(tmp_path / 'whole.nii', v, g.grid, 'density per mm')
    if name.endswith('.nii'):
        assert (tmp_path / name).read_bytes() == (tmp_path / 'whole.nii').read_bytes()
    actual, whole = read_volume(tmp_path / name), read_volume(tmp_path / 'whole.nii')
    np.testing.assert_array_equal(actual.data, v)
    np.testing.assert_array_equal(actual.affine, whole.affine)
    assert actual.unit == whole.unit == 'density per mm'


@pytest.mark.parametrize('thickness', [64, 7, 1])
def test_ome_zarr(tmp_path, thickness):
    zarr = pytest.importorskip('zarr')
    g, v = geometry((140, 30, 43)), noise((140, 30, 43))
    write_slabs(tmp_path / 'v.ome.zarr', g.grid, slabs(v, thickness))
    group = zarr.open_group(str(tmp_path / 'v.ome.zarr'), mode='r')
    np.testing.assert_array_equal(np.asarray(group['0'][:]).transpose(2, 1, 0), v)
    level, want = 1, v.transpose(2, 1, 0)
    while str(level) in group:
        z, y, x = (n // 2 * 2 for n in want.shape)
        want = want[:z, :y, :x].reshape(z // 2, 2, y // 2, 2, x // 2, 2).mean((1, 3, 5))
        np.testing.assert_allclose(group[str(level)][:], want, rtol=1e-6)
        level += 1
    assert level == 3
    (image,) = group.attrs['ome']['multiscales']
    assert [axis['name'] for axis in image['axes']] == ['z', 'y', 'x'] and image['axes'][0]['unit'] == 'millimeter'
    corner = g.grid.first_voxel[::-1]
    for i, dataset in enumerate(image['datasets']):
        scale, place = (t[t['type']] for t in dataset['coordinateTransformations'])
        np.testing.assert_allclose(scale, np.array(g.grid.spacing)[::-1] * 2**i)
        # The outer corner of all levels is the same.
        np.testing.assert_allclose(np.array(place) - np.array(scale) / 2, corner - np.array(g.grid.spacing)[::-1] / 2)


def test_ome_zarr_is_valid(tmp_path):
    """Other authors' models of the specification accept it."""
    models = pytest.importorskip('ome_zarr_models.v05')
    zarr = pytest.importorskip('zarr')
    write_slabs(tmp_path / 'v.ome.zarr', geometry((70, 20, 10)).grid, slabs(noise((70, 20, 10)), 10))
    image = models.Image.from_zarr(zarr.open_group(str(tmp_path / 'v.ome.zarr'), mode='r'))
    assert len(image.ome_attributes.multiscales[0].datasets) == 2


@pytest.mark.parametrize('name', ['v.nii', 'v.ome.zarr'])
def test_bad_slabs(tmp_path, name):
    if name.endswith('.zarr'):
        pytest.importorskip('zarr')
    g, v = geometry((70, 6, 11)), noise((70, 6, 11))
    for bad in (slabs(v[:, :, :10], 4), slabs(v[:, :5], 4), slabs(np.concatenate([v, v], 2), 6), slabs(v * np.nan, 4)):
        with pytest.raises(InputError, match='slab|NaN'):
            write_slabs(tmp_path / name, g.grid, bad)
        assert not any(tmp_path.iterdir())
    with pytest.raises(InputError, match='NIfTI'):
        write_slabs(tmp_path / 'v.tif', g.grid, slabs(v, 4))


@pytest.mark.parametrize('thickness', [1, 5, 8, 24])
def test_fdk(thickness):
    g = geometry((24, 20, 16), (4.0, 5.0, 6.0))
    scan = lm.simulate(noise((24, 20, 16)), g, progress=False).train
    whole = run_algorithm(scan, lm.FDK()).volume
    volume = np.concatenate(list(lm.FDK().slabs(scan, thickness)), 2)
    assert np.abs(volume - whole).max() < 2e-6 * np.abs(whole).max()


def test_a_cloud(tmp_path):
    (tmp_path / 'tiny.xml').write_text(SCENE)
    data = lm.simulate(tmp_path / 'tiny.xml')
    result = lm.fit(data, 'fast', iterations=15, n_points=150, progress=False)
    grid = Grid((30, 26, 50), (0.8, 0.9, 0.5))
    whole = result.volume(grid)
    result.save_volume(tmp_path / 'v.nii', grid, slab=7)
    assert np.abs(read_volume(tmp_path / 'v.nii').data - whole).max() < 2e-6 * whole.max() and whole.max() > 0
    with pytest.raises(InputError, match='exists already'):
        result.save_volume(tmp_path / 'v.nii')


@pytest.mark.thorough
def test_completed_views_need_no_volume(tmp_path, monkeypatch):
    scene = tmp_path / 'tiny.xml'
    scene.write_text(SCENE)
    data = lm.simulate(scene)
    lm.fit(data, 'fast', iterations=10, n_points=100, progress=False).save(tmp_path / 'fit')
    large = data.train.geometry.on(Grid((120, 120, 24), 1))
    write_scan(tmp_path / 'scan.npy', lm.Scan(large, data.train.projections), 'npy')
    arguments = '--projections', tmp_path / 'scan.npy', '--algorithm', 'sart', '-D', 'niter=1'
    views = '--complete', tmp_path / 'fit' / 'result.xml', '--views', 12
    command = RECONSTRUCT, scene, *arguments, *views, '--out', tmp_path / 'v.nii'
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 4e6)  # bytes; the volume has 1.4e6
    code, _, err = run(*command)
    assert code == 2 and 'of memory' in err
    code, _, err = run(*command, '--slab', 4)
    assert code == 0 and read_volume(tmp_path / 'v.nii').data.shape == (120, 120, 24), err


def test_a_scene_whose_volume_is_larger_than_memory(tmp_path, monkeypatch):
    scene = tmp_path / 'tiny.xml'
    scene.write_text(SCENE.replace('24, 24, 24', '120, 120, 24').replace('"1, 1, 1"', '"0.2, 0.2, 1"'))
    command = RECONSTRUCT, scene, '--algorithm', 'fdk', '--out', tmp_path / 'v.nii'
    code, out, err = run(*command)
    assert code == 0, err
    whole = read_volume(tmp_path / 'v.nii').data
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 4e6)  # bytes; the volume has 1.4e6
    code, _, err = run(*command, '--force')
    assert code == 2 and 'of memory' in err
    code, _, err = run(*command, '--force', '--slab', 4)
    assert code == 0, err
    np.testing.assert_allclose(read_volume(tmp_path / 'v.nii').data, whole, atol=1e-5 * whole.max())


def test_a_scan_whose_volume_is_larger_than_memory(tmp_path, monkeypatch):
    g = geometry((120, 120, 24))
    write_scan(tmp_path / 'scan.npy', lm.Scan(g, noise((9, 40, 48))), 'npy')
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 4e6)
    scan = lm.load(tmp_path / 'scan.npy').train
    assert next(lm.FDK().slabs(scan, 4)).shape == (120, 120, 4)
    for work in lambda: lm.fit(scan), lambda: lm.reconstruct(scan, lm.FDK()):
        with pytest.raises(InputError, match='of memory'):
            work()
    monkeypatch.setattr('lingo_mi.scene.checks.room', lambda: 4e5)
    with pytest.raises(InputError, match='of memory'):
        next(lm.FDK().slabs(scan, 4))


def test_the_command(tmp_path):
    zarr = pytest.importorskip('zarr')
    scene = tmp_path / 'tiny.xml'
    scene.write_text(SCENE)
    code, _, err = run(FIT, scene, '--iterations', 10, '-D', 'n_points=100', '--out', tmp_path / 'fit')
    assert code == 0, err
    for algorithm, more in (('fdk', ()), ('voxelize', ('--complete', tmp_path / 'fit' / 'result.xml'))):
        names = [
            tmp_path / f'{algorithm}{end}' for end in ('.nii.gz', '-slabs.nii.gz', '-slabs.ome.zarr', '-whole.ome.zarr')
        ]
        for name in names:
            slab = ('--slab', 8) if 'slabs' in name.name else ()
            code, text, err = run(RECONSTRUCT, scene, '--algorithm', algorithm, *more, *slab, '--out', name)
            assert code == 0 and str(name) in text, err
        whole = read_volume(names[0]).data
        actual = [
            read_volume(names[1]).data,
            *(zarr.open_group(str(n), mode='r')['0'][:].transpose(2, 1, 0) for n in names[2:]),
        ]
        for volume in actual:
            assert np.abs(volume - whole).max() < 2e-6 * np.abs(whole).max()
    code, _, err = run(RECONSTRUCT, scene, '--algorithm', 'cgls', '--slab', 8, '--out', tmp_path / 'x.nii')
    assert code == 2 and '--algorithm cgls needs the whole volume: leave out --slab, or' in err
    code, _, err = run(RECONSTRUCT, scene, '--out', names[3], '--force')
    assert code == 2 and 'is a folder' in err


PROGRAM = """
import sys, json
from pathlib import Path
import numpy as np
import lingo_mi as lm
from lingo_mi.common.runtime import use_variant
use_variant('llvm_ad_mono')
from lingo_mi.files.slabs import write_slabs

def go(nz, out):
    g = lm.Geometry.cone(DSO=1000, DSD=1500, nDetector=64, dDetector=8, nVoxel=(256, 256, nz), dVoxel=1, angles=np.arange(8.0))
    scan = lm.Scan(g, np.ones((8, 64, 64), np.float32))
    write_slabs(out, g.grid, lm.FDK().slabs(scan, 16))

def peak():
    return 1024 * next(int(l.split()[1]) for l in open('/proc/self/status') if l.startswith('VmHWM'))

go(32, sys.argv[1] + '/a.nii')
before = peak()
go(int(sys.argv[2]), sys.argv[1] + '/b.nii')
print(before, peak())
"""


@pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='asks Linux for its peak memory')
@pytest.mark.thorough
def test_memory_is_that_of_a_slab(tmp_path):
    """A volume with sixteen times the slices, 134 MB, takes no more memory."""
    command = [sys.executable, '-c', PROGRAM, str(tmp_path), '512']
    before, peak = map(int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert (tmp_path / 'b.nii').stat().st_size > 4 * 256 * 256 * 512 and peak - before < 15e6, (before, peak)
