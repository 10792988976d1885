"""The reader of napari: layers in mm from each kind of file and from a result; and a manifest whose names exist."""

import importlib
from importlib.resources import files

import numpy as np
import pytest
import yaml

import lingo_mi as lm
from lingo_mi.files.ply import write_ply
from lingo_mi.files.scans import write_scan
from lingo_mi.files.volumes import write_volume
from lingo_mi.geometry import Geometry, circular
from lingo_mi.napari.reader import read, reader_of
from lingo_mi.scan import Scan


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A result's volume and cloud, and a scan beside them."""
    folder = tmp_path_factory.mktemp('result')
    rng = np.random.default_rng(0)
    geometry = Geometry.cone(
        angles=circular(5), DSO=100, DSD=150, nDetector=(6, 8), dDetector=(2, 3), nVoxel=(4, 5, 6), dVoxel=(1, 2, 3)
    )
    write_volume(folder / 'volume.nii.gz', rng.random((4, 5, 6), np.float32), geometry.grid, '1/mm')
    quaternions = np.tile([0.0, 0, 0, 1], (7, 1))
    write_ply(folder / 'gaussians.ply', rng.random((7, 3)), np.full((7, 3), 0.5), quaternions, np.ones(7))
    write_scan(folder / 'scan.npy', Scan(geometry, rng.random((5, 6, 8), np.float32)), 'npy')
    return folder


def test_a_result_is_its_volume_and_its_cloud(folder):
    assert reader_of(str(folder)) is read
    (volume, options, kind), (points, of_points, other) = read(str(folder))
    assert (kind, other) == ('image', 'points')
    assert volume.shape == (6, 5, 4)
    np.testing.assert_allclose(options['scale'], (3, 2, 1))
    np.testing.assert_allclose(options['translate'], (-7.5, -4, -1.5))
    assert points.shape == (7, 3)
    np.testing.assert_allclose(of_points['size'], 1)
    np.testing.assert_allclose(points[:, ::-1], np.random.default_rng(0).random((7, 3)), atol=2)


def test_projections_are_a_stack(folder):
    [(views, options, kind)] = read([str(folder / 'scan.npy')])
    assert (views.shape, kind, options['scale']) == ((5, 6, 8), 'image', (1, 2.0, 3.0))
    assert len(options['metadata']['angles']) == 5


def test_what_it_does_not_know_is_left_to_others(folder, tmp_path):
    assert reader_of(str(tmp_path)) is None
    assert reader_of([str(folder / 'volume.nii.gz'), str(tmp_path / 'picture.png')]) is None


def test_a_damaged_file_is_one_line(tmp_path):
    (tmp_path / 'volume.nii.gz').write_bytes(b'nothing')
    with pytest.raises(lm.InputError, match=r'volume\.nii\.gz'):
        read(str(tmp_path / 'volume.nii.gz'))


def test_the_manifest_names_what_is_there():
    manifest = yaml.safe_load(files('lingo_mi.napari').joinpath('napari.yaml').read_text())
    names = [command['python_name'].partition(':') for command in manifest['contributions']['commands']]
    assert names[0][0] == 'lingo_mi.napari.reader' and hasattr(importlib.import_module(names[0][0]), names[0][2])
    pytest.importorskip('magicgui', reason='napari is not installed: pip install -e .[napari]')
    pytest.importorskip('superqt')
    assert hasattr(importlib.import_module(names[1][0]), names[1][2])


def test_the_manifest_is_valid():
    npe2 = pytest.importorskip('npe2', reason='napari is not installed: pip install -e .[napari]')
    npe2.PluginManifest.from_file(str(files('lingo_mi.napari').joinpath('napari.yaml')))
