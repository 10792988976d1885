"""Volumes in other units, and as DICOM: read back by this package and by others."""

import argparse

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.cli.common import read_input
from lingo_mi.common.errors import InputError
from lingo_mi.files.slabs import write_slabs
from lingo_mi.files.units import PER_MM, Unit, unit_of
from lingo_mi.files.volumes import read_volume
from lingo_mi.reconstruction import Reconstruction

GRID = lm.Grid((5, 6, 7), (0.5, 0.75, 1.25), (3.0, -2.0, 10.0))
WATER = 0.0206


@pytest.fixture(scope='module')
def reconstruction():
    """Air, water, bone and what noise makes of air."""
    density = np.random.default_rng(0).uniform(-0.002, 0.05, GRID.shape).astype(np.float32)
    density[0, 0, :3] = 0, WATER, 2 * WATER
    return Reconstruction(density, [], 0.0, GRID)


def hounsfield(density):
    return 1000 * (density.astype(np.float64) / WATER - 1)


def test_values_in_every_unit():
    density = np.array([0, WATER, 2 * WATER], np.float32)
    np.testing.assert_allclose(unit_of('hu', WATER).values(density), [-1000, 0, 1000], atol=1e-3)
    np.testing.assert_allclose(unit_of('1/cm').values(density), [0, 0.206, 0.412], rtol=1e-6)
    assert unit_of('1/mm').values(density) is density
    for unit in (unit_of('hu', WATER), unit_of('1/cm'), PER_MM):
        np.testing.assert_allclose(unit.densities(unit.values(density)), density, atol=1e-8)
        assert Unit.described(unit.description) == unit
    assert Unit.described('normalised') is None


@pytest.mark.parametrize(
    ('units', 'mu_water', 'message'),
    [
        ('hu', None, 'needs the attenuation of water in 1/mm: give mu_water='),
        ('hu', 0.0, 'must be positive'),
        ('hu', 'water', 'must be positive'),
        ('1/cm', 0.02, "is for units='hu'"),
        ('1/m', None, "must be '1/mm', '1/cm' or 'hu'"),
    ],
)
def test_units_that_are_refused(reconstruction, tmp_path, units, mu_water, message):
    with pytest.raises(InputError, match=message):
        reconstruction.save(tmp_path / 'v.nii', units=units, mu_water=mu_water)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize('name', ['v.nii', 'v.nii.gz', 'v.ome.zarr'])
@pytest.mark.parametrize(('units', 'mu_water'), [('1/cm', None), ('hu', WATER)])
def test_a_volume_in_other_units_is_read_as_densities(reconstruction, tmp_path, name, units, mu_water):
    if name.endswith('zarr'):
        pytest.importorskip('ome_zarr')
    read = read_volume(reconstruction.save(tmp_path / name, units=units, mu_water=mu_water))
    np.testing.assert_allclose(read.data, reconstruction.volume, atol=2e-8)
    assert read.unit == 'density per mm' and read.spacing == GRID.spacing


def test_nifti_says_its_unit_to_others(reconstruction, tmp_path):
    nibabel = pytest.importorskip('nibabel')
    image = nibabel.load(reconstruction.save(tmp_path / 'v.nii.gz', units='hu', mu_water=WATER))
    assert bytes(image.header['descrip'].item()).startswith(b'lingo_mi: HU, water 0.0206 per mm')
    np.testing.assert_allclose(image.get_fdata(), hounsfield(reconstruction.volume), atol=1e-3)
    np.testing.assert_allclose(image.affine[:3, 3], GRID.first_voxel)


@pytest.fixture(scope='module')
def series(reconstruction, tmp_path_factory):
    pytest.importorskip('pydicom')
    return reconstruction.save(tmp_path_factory.mktemp('dicom') / 'v.dicom', units='hu', mu_water=WATER)


def test_dicom_is_read_back_with_its_place(reconstruction, series, tmp_path):
    read, nifti = read_volume(series, mu_water=WATER), read_volume(reconstruction.save(tmp_path / 'v.nii'))
    np.testing.assert_allclose(
        read.data, np.maximum(reconstruction.volume, 0), atol=0.51 * WATER / 1000
    )  # steps of 1 HU
    np.testing.assert_allclose(read.affine, nifti.affine, atol=1e-6)
    assert read.spacing == pytest.approx(GRID.spacing)


def test_dicom_for_pydicom(reconstruction, series):
    pydicom = pytest.importorskip('pydicom')
    slices = [pydicom.dcmread(file) for file in sorted(series.iterdir())]
    assert len(slices) == 7
    first = slices[0]
    assert first.Modality == 'CT' and first.SOPClassUID.name == 'CT Image Storage' and first.RescaleType == 'HU'
    for name in ('StudyInstanceUID', 'SeriesInstanceUID', 'FrameOfReferenceUID'):
        assert len({s[name].value for s in slices}) == 1
    assert len({s.SOPInstanceUID for s in slices}) == 7 and [s.InstanceNumber for s in slices] == list(range(1, 8))
    assert list(first.PixelSpacing) == [0.75, 0.5] and first.SliceThickness == 1.25
    for k, s in enumerate(slices):
        x, y, z = GRID.first_voxel
        np.testing.assert_allclose(np.array(s.ImagePositionPatient, float), [-x, -y, z + 1.25 * k])
        values = s.pixel_array * float(s.RescaleSlope) + float(s.RescaleIntercept)
        np.testing.assert_allclose(values, hounsfield(reconstruction.volume)[:, :, k].T, atol=0.51)


def test_dicom_for_simpleitk(reconstruction, series):
    itk = pytest.importorskip('SimpleITK')
    names = itk.ImageSeriesReader.GetGDCMSeriesFileNames(str(series))
    image = itk.ReadImage(names)
    np.testing.assert_allclose(image.GetSpacing(), GRID.spacing)
    np.testing.assert_allclose(itk.GetArrayFromImage(image).T, hounsfield(reconstruction.volume), atol=0.51)
    for index in ((0, 0, 0), (4, 5, 6)):
        right, front, up = np.array(GRID.first_voxel) + np.array(index) * GRID.spacing  # NIfTI's axes
        np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(index), [-right, -front, up], atol=1e-6)


def test_dicom_that_cannot_be_written(reconstruction, tmp_path):
    pytest.importorskip('pydicom')
    with pytest.raises(InputError, match="are in Hounsfield units: give units='hu'"):
        reconstruction.save(tmp_path / 'v.dicom')
    with pytest.raises(InputError, match='do not fit into the 16 bits'):
        reconstruction.save(tmp_path / 'v.dicom', units='hu', mu_water=1e-3)
    assert not any(tmp_path.iterdir())


def test_slabs_make_the_same_series(reconstruction, series, tmp_path):
    pydicom = pytest.importorskip('pydicom')
    slabs = (reconstruction.volume[:, :, a:b] for a, b in GRID.slabs(3))
    write_slabs(tmp_path / 'v.dicom', GRID, slabs, unit_of('hu', WATER))
    for a, b in zip(sorted(series.iterdir()), sorted((tmp_path / 'v.dicom').iterdir())):
        assert pydicom.dcmread(a).PixelData == pydicom.dcmread(b).PixelData


@pytest.mark.parametrize(
    ('values', 'expected'),
    [
        (lambda mu: 1000 * (mu / WATER - 1), 1.0),  # Hounsfield units
        (lambda mu: mu, 1.0),  # per mm
        (lambda mu: np.uint8(10_000 * mu), None),
        (lambda mu: 100 * mu, None),
    ],
)
def test_a_volume_to_scan_and_to_write_in_hounsfield_units(tmp_path, monkeypatch, values, expected):
    """--volume with --units hu and --mu-water: what has no unit of attenuation is refused, in one line that helps."""
    monkeypatch.setattr('lingo_mi.scene.simulate.take_scan', lambda scene, views, volume, *_, **__: volume.data)
    mu = np.zeros((8, 8, 8), np.float32)
    mu[2:6, 2:6, 2:6] = 0.02
    np.save(tmp_path / 'v.npy', values(mu))
    options = dict(volume=str(tmp_path / 'v.npy'), projections=None, shape=None, dtype=None, spacing=[4.0], units='hu')
    args = argparse.Namespace(**options, mu_water=WATER)
    if expected is None:
        with pytest.raises(InputError, match="not attenuation per mm, so units='hu' cannot be written"):
            read_input(args, None, 0)
    else:
        np.testing.assert_allclose(read_input(args, None, 0), expected * mu, atol=1e-6)
