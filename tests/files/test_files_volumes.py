"""CT volumes: every format with asymmetric data, the rules from values to density, and bad input."""

import ast
import builtins
import io
import os
import struct
import subprocess
import sys
import time
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lingo_mi.common.errors import InputError, brief
from lingo_mi.files import volumes, voxels
from lingo_mi.files.volumes import centred_affine, git_blob_sha1, read_volume, write_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage import file_access

SHAPE, SPACING = (4, 5, 6), (0.5, 1.0, 2.5)
COUNTS = np.arange(120, dtype=np.uint8).reshape(SHAPE)
HU = COUNTS.astype(np.int16) * 25 - 1000


def refused(path, match, **options):
    with pytest.raises(InputError, match=match) as caught:
        read_volume(path, **options)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def needs(module):
    return pytest.importorskip(module, reason=f'{module} (the `formats` extra) is not installed')


# ---- values ------------------------------------------------------------------------------------------------


def read_array(tmp_path, array, **options):
    np.save(tmp_path / 'v.npy', array)
    return read_volume(tmp_path / 'v.npy', **options)


def test_counts_are_divided_by_their_maximum(tmp_path):
    v = read_array(tmp_path, COUNTS)
    assert v.data.dtype == np.float32 and v.unit == 'normalised'
    np.testing.assert_allclose(v.data, COUNTS / 119, rtol=1e-6)


def test_hounsfield_units_by_the_clip_rule(tmp_path):
    hu = HU.copy()
    hu[0, 0, :4] = -3000, 0, 500, 3071
    v = read_array(tmp_path, hu)
    np.testing.assert_allclose(v.data[0, 0, :4], [0, 1 / 3, 0.5, 1], rtol=1e-6)
    assert v.unit == 'normalised' and v.data.min() == 0 and v.data.max() == 1


def test_hounsfield_units_with_mu_water(tmp_path):
    hu = HU.copy()
    hu[0, 0, :4] = -3000, -1000, 0, 1000
    v = read_array(tmp_path, hu, mu_water=0.02)
    np.testing.assert_allclose(v.data[0, 0, :4], [0, 0, 0.02, 0.04], rtol=1e-6)
    assert v.unit == '1/mm'


def test_density_within_0_and_1_is_kept(tmp_path):
    density = (COUNTS / 300).astype(np.float64)
    np.testing.assert_array_equal(read_array(tmp_path, density).data, density.astype(np.float32))


def test_noise_below_zero_becomes_zero_and_large_floats_are_scaled(tmp_path):
    density = COUNTS / 60 - 0.05
    v = read_array(tmp_path, density)
    assert v.data.min() == 0 and v.data.max() == 1
    assert v.data[2, 3, 4] == pytest.approx(density[2, 3, 4] / density.max())


def test_ambiguous_negative_values_ask_for_hu(tmp_path):
    for crop in (COUNTS.astype(int) - 20, COUNTS - 20.0, COUNTS / 60 - 0.5):
        np.save(tmp_path / 'v.npy', crop)
        refused(tmp_path / 'v.npy', 'give mu_water=MU.*hu=True.*hu=False')
    np.save(tmp_path / 'v.npy', COUNTS.astype(int) - 20)
    np.testing.assert_allclose(read_volume(tmp_path / 'v.npy', hu=True).data, (COUNTS - 20.0 + 1000) / 3000, rtol=1e-6)
    assert read_volume(tmp_path / 'v.npy', hu=False).data.min() == 0
    # As --mu-water says.
    np.testing.assert_allclose(
        read_volume(tmp_path / 'v.npy', mu_water=0.02).data, 0.02 * (COUNTS - 20.0 + 1000) / 1000, rtol=1e-6
    )
    np.save(tmp_path / 'v.npy', HU)
    np.testing.assert_allclose(read_volume(tmp_path / 'v.npy', hu=False).data, np.maximum(HU, 0) / HU.max(), rtol=1e-6)


def test_bad_values(tmp_path):
    for array, match, options in (
        (COUNTS * 0, 'empty', {}),
        (COUNTS[0], '3 dimensions', {}),
        (COUNTS[:0], 'filled', {}),
        (np.full(SHAPE, np.nan), 'NaN', {}),
        (np.full(SHAPE, 1j), 'real numbers', {}),
        (COUNTS, 'do not look like Hounsfield', {'mu_water': 0.02}),
        (HU, 'mu_water must be', {'mu_water': -1}),
        (HU, 'mu_water must be', {'mu_water': 0}),
        (COUNTS, 'spacing must be', {'spacing': (1, 2)}),
        (COUNTS, 'spacing must be', {'spacing': 0}),
        (COUNTS, 'spacing must be', {'spacing': 'a'}),
    ):
        np.save(tmp_path / 'v.npy', array)
        refused(tmp_path / 'v.npy', match, **options)


# ---- NIfTI -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('suffix', ['.nii', '.nii.gz'])
@pytest.mark.parametrize('scale', [1, 700])
def test_our_nifti_round_trips_unchanged(tmp_path, suffix, scale):
    """Also with values that a stranger's file would have divided by their maximum or clipped."""
    path = tmp_path / f'v{suffix}'
    data = ((COUNTS / 100 - 0.9) * scale).astype(np.float32)
    write_volume(path, data, Grid(SHAPE, SPACING, (1.75, 4.0, 9.25)), description='1/mm')
    v = read_volume(path)
    np.testing.assert_array_equal(v.data, data)
    assert v.spacing == pytest.approx(SPACING) and v.unit == '1/mm'
    np.testing.assert_allclose(v.affine[:3, 3], [1, 2, 3])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_nifti_header_and_place(tmp_path):
    import nibabel

    path = tmp_path / 'v.nii'
    write_volume(path, COUNTS, Grid(SHAPE, SPACING, (10, 20, 30)), 'normalised')
    image = nibabel.load(path)
    assert image.header.get_xyzt_units()[0] == 'mm' and b'normalised' in image.header['descrip'].item()
    assert image.get_data_dtype() == np.float32
    # the middle of the volume, between voxels in x and z, is the grid's centre
    np.testing.assert_allclose(image.affine @ [1.5, 2, 2.5, 1], [10, 20, 30, 1])
    write_volume(path, COUNTS, Grid(SHAPE, SPACING))
    np.testing.assert_allclose(nibabel.load(path).affine @ [1.5, 2, 2.5, 1], [0, 0, 0, 1], atol=1e-6)
    assert read_volume(path).unit == 'normalised'


@pytest.mark.parametrize('name', ['v.hdr', 'v.img'])
def test_a_header_beside_its_voxels(tmp_path, name):
    import nibabel

    nibabel.save(nibabel.Nifti1Pair(COUNTS, np.diag([*SPACING, 1])), tmp_path / 'v.img')
    v = read_volume(tmp_path / name)
    np.testing.assert_allclose(v.data, COUNTS / 119, rtol=1e-6)
    assert v.spacing == SPACING


@pytest.mark.parametrize('unit, mm', [('mm', 1), ('meter', 1000), ('micron', 1e-3), ('unknown', 1)])
def test_foreign_nifti(tmp_path, unit, mm):
    import nibabel

    affine = np.array([[-0.5, 0, 0, 7], [0, 0, 2.5, 8], [0, 1, 0, 9], [0, 0, 0, 1.0]])
    image = nibabel.Nifti1Image(HU[..., None], affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / 'v.nii.gz')
    v = read_volume(tmp_path / 'v.nii.gz', mu_water=0.02)
    np.testing.assert_allclose(v.data, 0.02 * (1 + HU / 1000.0), rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(v.spacing, np.array([0.5, 1, 2.5]) * mm, rtol=1e-6)
    np.testing.assert_allclose(v.affine[:3], affine[:3] * mm, rtol=1e-6)


@pytest.mark.parametrize('row, column, value', [(0, 3, np.nan), (1, 1, 0.0), (2, 2, np.inf)])
def test_a_nifti_without_a_voxel_size_or_a_place(tmp_path, row, column, value):
    import nibabel

    affine = np.diag([*SPACING, 1.0])
    affine[row, column] = value
    image = nibabel.Nifti1Image(COUNTS, np.eye(4))
    image.header.set_sform(affine, code=1)
    path = tmp_path / 'v.nii'
    path.write_bytes(image.header.binaryblock + bytes(4) + COUNTS.tobytes('F'))
    refused(path, 'no valid voxel size')


def test_bad_nifti(tmp_path):
    path = tmp_path / 'v.nii'
    refused(path, 'no such file')
    write_volume(path, COUNTS, Grid(SHAPE, SPACING))
    raw = path.read_bytes()
    for content in (b'', b'hello', raw[:200], raw[:-9]):
        path.write_bytes(content)
        assert str(path) in refused(path, 'damaged')
    zipped = tmp_path / 'v.nii.gz'
    write_volume(zipped, COUNTS, Grid(SHAPE, SPACING))
    raw = zipped.read_bytes()
    for content in (b'', b'hello', raw[:100], raw[:-9]):
        zipped.write_bytes(content)
        assert str(zipped) in refused(zipped, 'damaged')
    write_volume(zipped, np.random.default_rng(0).uniform(0, 1, (40, 40, 40)), Grid(40, SPACING))
    raw = zipped.read_bytes()
    zipped.write_bytes(raw[:-8] + bytes([raw[-8] ^ 1]) + raw[-7:])  # the check sum, which nibabel does not reach
    refused(zipped, 'CRC')
    import nibabel

    nibabel.save(nibabel.Nifti1Image(np.ones((2, 3, 4, 5), np.float32), np.eye(4)), path)
    refused(path, '3 dimensions')
    write_volume(path, COUNTS, Grid(SHAPE, SPACING))
    refused(path, 'its own voxel size', spacing=1)


def test_write_refuses(tmp_path):
    for args, match in (
        ((tmp_path / 'v.mha', COUNTS, Grid(SHAPE, 1)), 'as NIfTI'),
        ((tmp_path / 'v.nii', COUNTS[0], Grid(SHAPE, 1)), '3 dimensions'),
        ((tmp_path / 'v.nii', COUNTS * np.nan, Grid(SHAPE, 1)), 'NaN'),
        ((tmp_path / 'v.nii', COUNTS, Grid(8, 1)), 'do not make'),
        ((tmp_path / 'v.nii', COUNTS, Grid(SHAPE, 1), 'x' * 80), 'room for 79'),
        ((tmp_path / 'none' / 'v.nii', COUNTS, Grid(SHAPE, 1)), 'cannot be written'),
    ):
        with pytest.raises(InputError, match=match):
            write_volume(*args)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / 'v.nii'
    write_volume(path, COUNTS, Grid(SHAPE, SPACING))
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'replace', full)
    with pytest.raises(InputError, match='No space left'):
        write_volume(path, COUNTS * 2, Grid(SHAPE, SPACING))
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_permissions(tmp_path, monkeypatch):
    path = tmp_path / 'v.npy'
    np.save(path, COUNTS)

    def denied(name, *args, **kwargs):
        raise PermissionError(13, 'Permission denied', str(name))

    monkeypatch.setattr(builtins, 'open', denied)
    refused(path, 'Permission denied')
    with pytest.raises(InputError, match='Permission denied'), file_access.replacing(tmp_path / 'w') as temporary:
        open(temporary, 'wb')  # noqa: SIM115


# ---- NumPy and raw -----------------------------------------------------------------------------------------


def test_npy_and_npz(tmp_path):
    v = read_array(tmp_path, COUNTS, spacing=SPACING)
    assert v.spacing == SPACING
    np.testing.assert_allclose(v.affine, centred_affine(SHAPE, SPACING))
    np.testing.assert_allclose(v.affine[:3, 3], [-0.75, -2, -6.25])
    with pytest.warns(UserWarning, match='v.npy: does not say its voxel size, and 1 mm is taken: give spacing=MM'):
        assert read_array(tmp_path, COUNTS).spacing == (1, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        read_array(tmp_path, COUNTS, spacing=1)
    np.savez(tmp_path / 'v.npz', volume=COUNTS, spacing=SPACING)
    np.testing.assert_allclose(read_volume(tmp_path / 'v.npz').data, COUNTS / 119, rtol=1e-6)


def test_bad_npy_and_npz(tmp_path):
    path = tmp_path / 'v.npz'
    refused(path, 'no such file')
    np.savez(path, a=COUNTS, b=COUNTS)
    refused(path, 'exactly one')
    raw = path.read_bytes()
    path.write_bytes(raw[:-20])
    refused(path, 'damaged')
    np.savez(path, a=np.array([{}]))
    refused(path, 'damaged')
    np.save(tmp_path / 'v.npy', COUNTS)
    os.replace(tmp_path / 'v.npy', path)
    refused(path, 'suffix')
    np.save(tmp_path / 'v.npy', np.array([[[{}]]]), allow_pickle=True)
    refused(tmp_path / 'v.npy', 'damaged')


@pytest.mark.parametrize('dtype', ['uint8', '>u2', '<f4'])
def test_raw_has_x_fastest(tmp_path, dtype):
    path = tmp_path / 'v.raw'
    path.write_bytes(
        b''.join(COUNTS[x, y, z].astype(dtype).tobytes() for z in range(6) for y in range(5) for x in range(4))
    )
    v = read_volume(path, shape=SHAPE, dtype=dtype, spacing=SPACING)
    np.testing.assert_allclose(v.data, COUNTS / 119, rtol=1e-6)
    assert v.spacing == SPACING
    other = tmp_path / 'v.dat'
    os.replace(path, other)
    np.testing.assert_array_equal(read_volume(other, shape=SHAPE, dtype=dtype).data, v.data)


def test_known_raw_files_need_no_shape(tmp_path, monkeypatch):
    assert git_blob_sha1(b'hello\n') == 'ce013625030ba8dba906f756967f9e9ca394464a'
    assert volumes._RAW_LAYOUTS['2888630277536561269f9632164e4b21088ab00d'] == ((256, 256, 256), 'uint8')
    path = tmp_path / 'known.raw'
    path.write_bytes(COUNTS.transpose(2, 1, 0).tobytes())
    refused(path, 'give the shape')
    monkeypatch.setitem(volumes._RAW_LAYOUTS, git_blob_sha1(path.read_bytes()), (SHAPE, 'uint8'))
    np.testing.assert_allclose(read_volume(path).data, COUNTS / 119, rtol=1e-6)
    path.write_bytes(COUNTS.transpose(2, 1, 0).astype('u2').tobytes())
    monkeypatch.setitem(volumes._RAW_LAYOUTS, git_blob_sha1(path.read_bytes()), (SHAPE, 'uint16'))
    np.testing.assert_allclose(read_volume(path).data, COUNTS / 119, rtol=1e-6)


def test_bad_raw(tmp_path):
    path = tmp_path / 'v.raw'
    refused(path, 'no such file')
    path.write_bytes(COUNTS.tobytes())
    for shape, dtype, match in (
        (SHAPE, 'uint16', '120 bytes'),
        ((4, 5), 'uint8', '3 positive'),
        ((0, 5, 6), 'uint8', '3 positive'),
        (SHAPE, 'no type', 'not understood'),
        (('a', 5, 6), 'uint8', 'not understood'),
        (SHAPE, None, 'give the shape'),
        (SHAPE, object, 'real numbers'),
        (SHAPE, 'i4,i4', 'real numbers'),
        (SHAPE, '(2,3)u1', 'real numbers'),
        (SHAPE, ',', 'not understood'),
        (SHAPE, '{', 'not understood'),
        (SHAPE, '9' * 400, 'not understood'),
        ((10**400, 5, 6), 'uint8', 'has 120 bytes'),
    ):
        refused(path, match, shape=shape, dtype=dtype)


# ---- NRRD, MetaImage, TIFF, DICOM --------------------------------------------------------------------------


@pytest.mark.parametrize('suffix', ['.nrrd', '.mha', '.mhd', '.nhdr'])
def test_itk_formats_agree_with_nifti(tmp_path, suffix):
    sitk = needs('SimpleITK')
    image = sitk.GetImageFromArray(HU.transpose(2, 1, 0))
    image.SetSpacing(SPACING)
    image.SetOrigin((7, 8, 9))
    image.SetDirection((0, -1, 0, 1, 0, 0, 0, 0, 1))
    sitk.WriteImage(image, str(tmp_path / f'v{suffix}'))
    sitk.WriteImage(image, str(tmp_path / 'v.nii'))
    a, b = read_volume(tmp_path / f'v{suffix}'), read_volume(tmp_path / 'v.nii')
    np.testing.assert_allclose(a.data, (HU + 1000) / 3000.0, rtol=1e-6)
    np.testing.assert_array_equal(a.data, b.data)
    np.testing.assert_allclose(a.affine, b.affine, atol=1e-5)
    assert a.spacing == pytest.approx(SPACING)


def test_bad_itk(tmp_path):
    sitk = needs('SimpleITK')
    refused(tmp_path / 'v.mha', 'no such file')
    (tmp_path / 'v.mha').write_bytes(b'hello')
    refused(tmp_path / 'v.mha', 'not a MetaImage file')
    (tmp_path / 'v.nrrd').write_bytes(b'hello')
    refused(tmp_path / 'v.nrrd', 'not an NRRD file')
    sitk.WriteImage(sitk.GetImageFromArray(COUNTS), str(tmp_path / 'v.mhd'))
    (tmp_path / 'v.raw').unlink()
    refused(tmp_path / 'v.mhd', 'v.raw: there is no such file')
    sitk.WriteImage(sitk.GetImageFromArray(COUNTS[0]), str(tmp_path / 'v.nrrd'))
    refused(tmp_path / 'v.nrrd', '2 dimensions')


IMAGEJ = dict(imagej=True, resolution=(1 / 4, 1 / 4))


@pytest.mark.parametrize(
    'name, written, spacing',
    [
        ('v.tif', dict(IMAGEJ, metadata=dict(axes='ZYX', spacing=5, unit='um')), (4e-3, 4e-3, 5e-3)),
        ('v.tif', dict(IMAGEJ, metadata=dict(axes='ZYX', spacing=0.5, unit='mm')), (4, 4, 0.5)),
        ('v.tif', dict(IMAGEJ, metadata=dict(axes='ZYX', unit='\\u00B5m')), (4e-3, 4e-3, 1e-3)),
        ('v.tif', dict(IMAGEJ, metadata=dict(axes='ZYX', spacing=5, unit='pixel')), (1, 1, 1)),
        (
            'v.ome.tif',
            dict(metadata=dict(axes='ZYX', PhysicalSizeX=4, PhysicalSizeY=3, PhysicalSizeZ=5, PhysicalSizeXUnit='nm')),
            (4e-6, 3e-3, 5e-3),
        ),
        ('v.tif', dict(resolution=(72, 72), resolutionunit='INCH', metadata=None), (1, 1, 1)),  # of a printer
    ],
)
def test_voxel_size_in_tiff(tmp_path, name, written, spacing):
    tifffile = needs('tifffile')
    tifffile.imwrite(tmp_path / name, COUNTS.transpose(2, 1, 0), photometric='minisblack', **written)
    volume = read_volume(tmp_path / name)
    np.testing.assert_allclose(volume.spacing, spacing, rtol=1e-6)
    np.testing.assert_allclose(volume.data, COUNTS / 119, rtol=1e-6)
    if spacing[0] != 1:
        refused(tmp_path / name, 'carries its own voxel size', spacing=2)


def test_slices_of_known_pixels_at_an_unknown_distance(tmp_path):
    tifffile = needs('tifffile')
    for z in range(6):
        metadata = dict(axes='YX', unit='um')
        tifffile.imwrite(tmp_path / f's{z}.tif', COUNTS[:, :, z].T, metadata=metadata, **IMAGEJ)
    refused(tmp_path, 'pixels are 0.004 x 0.004 mm.*give spacing=')
    assert read_volume(tmp_path, spacing=(4e-3, 4e-3, 0.01)).spacing == pytest.approx((4e-3, 4e-3, 0.01))


def test_tiff_stack_and_folder(tmp_path):
    tifffile = needs('tifffile')
    tifffile.imwrite(tmp_path / 'v.tif', COUNTS.transpose(2, 1, 0), photometric='minisblack')
    a = read_volume(tmp_path / 'v.tif', spacing=SPACING)
    (tmp_path / 'slices').mkdir()
    for z in range(6):  # 8, 9, 10, …: names that sort wrongly as text
        tifffile.imwrite(tmp_path / 'slices' / f's{z + 8}.tiff', COUNTS[:, :, z].T)
    b = read_volume(tmp_path / 'slices')
    for v in (a, b):
        np.testing.assert_allclose(v.data, COUNTS / 119, rtol=1e-6)
    assert a.spacing == SPACING
    with tifffile.TiffWriter(tmp_path / 'plain.tiff') as writer:  # images one after another, without a word about them
        for z in (*range(6), *range(6)):
            writer.write(COUNTS[:, :, z].T, metadata=None, contiguous=False)
    with tifffile.TiffFile(tmp_path / 'plain.tiff') as file:
        assert file.series[0].kind == 'uniform'
    twice = np.concatenate([COUNTS, COUNTS], 2)
    np.testing.assert_allclose(read_volume(tmp_path / 'plain.tiff').data, twice / 119, rtol=1e-6)
    tifffile.imwrite(tmp_path / 'slices' / 's20.tiff', COUNTS[:, :, 0])
    refused(tmp_path / 'slices', 'one size')
    (tmp_path / 'slices' / 's20.tiff').write_bytes(b'hello')
    assert 's20.tiff' in refused(tmp_path / 'slices', 'damaged')
    refused(tmp_path / 'none.tif', 'no such file')


OME = (
    '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0"><Pixels '
    'DimensionOrder="XYCZT" ID="P" SizeC="1" SizeT="9999" SizeX="4" SizeY="5" SizeZ="9999" Type="uint8"><TiffData '
    'IFD="0" PlaneCount="99999999"/></Pixels></Image></OME>'
)


@pytest.mark.parametrize(
    'description', [OME, 'ImageJ=1.11a\nimages=999999999\nslices=999999999\n', '{"shape": [99999999, 5, 4]}']
)
def test_a_tiff_that_describes_more_images_than_it_has(tmp_path, description):
    tifffile = needs('tifffile')
    path = tmp_path / 'v.tif'
    tifffile.imwrite(path, COUNTS[:, :, 0].T + 1, description=description, metadata=None)
    start = time.monotonic()
    try:
        assert read_volume(path).data.shape == (4, 5, 1)  # the image that there is
    except InputError as error:
        assert 'truncated or damaged' in str(error)
    assert time.monotonic() - start < 5


@pytest.mark.parametrize('bigtiff', [False, True])
@pytest.mark.parametrize('byteorder', '<>')
def test_a_tiff_whose_images_have_no_end(tmp_path, bigtiff, byteorder):
    tifffile = needs('tifffile')
    path = tmp_path / 'v.tif'
    tifffile.imwrite(path, COUNTS.transpose(2, 1, 0), photometric='minisblack', bigtiff=bigtiff, byteorder=byteorder)
    np.testing.assert_allclose(read_volume(path).data, COUNTS / 119, rtol=1e-6)
    with tifffile.TiffFile(path) as file:
        places = [page.offset for page in file.pages]
    content, (link, count, entry) = path.read_bytes(), (('Q', 'Q', 20) if bigtiff else ('I', 'H', 12))
    for at in places[1:]:  # from the last image back to another
        (entries,) = struct.unpack_from(byteorder + count, content, places[-1])
        end = places[-1] + struct.calcsize(byteorder + count) + entries * entry
        circle = bytearray(content)
        struct.pack_into(byteorder + link, circle, end, at)
        path.write_bytes(circle)
        refused(path, 'has no end')


# By TIFF's numbers: bytes, deflate by its authors' word (at most 1032:1), and PackBits, whose longest run takes 2 bytes for 128.
@pytest.mark.parametrize('compression, ratio', [(1, 1), (8, 1032), (32946, 1032), (32773, 64)])
def test_what_a_tiff_file_may_claim(tmp_path, compression, ratio):
    """It may claim as many bytes as its compression can make of the whole file, and not one more."""
    tifffile = needs('tifffile')
    path = tmp_path / 'v.tif'
    tifffile.imwrite(path, np.zeros((1, 999), np.uint8), photometric='minisblack', rowsperstrip=1, metadata=None)
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        tags, order = file.pages[0].tags, file.byteorder
        struct.pack_into(order + 'H', content, tags['Compression'].valueoffset, compression)
        width = tags['ImageWidth']
    assert width.dtype == tifffile.DATATYPE.LONG
    for more in (0, 1):
        struct.pack_into(order + 'I', content, width.valueoffset, len(content) * ratio + more)
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:  # there are not that many bytes, but there could be
            read_volume(path)
        assert ('cannot hold' in str(caught.value)) == bool(more)


def dicom_slice(path, z, pixels, **changes):
    pydicom = needs('pydicom')
    data = pydicom.Dataset()
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = pydicom.uid.generate_uid()
    data.SOPClassUID = pydicom.uid.CTImageStorage
    data.SeriesInstanceUID = '1.2.3'
    data.Rows, data.Columns = pixels.shape
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, 'MONOCHROME2'
    data.BitsAllocated = data.BitsStored = 16
    data.HighBit, data.PixelRepresentation = 15, 1
    data.PixelSpacing, data.SliceThickness = [1.0, 0.5], 9.0
    data.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    data.ImagePositionPatient = [7, 8, z]
    data.RescaleSlope, data.RescaleIntercept = 2, -1000
    data.PixelData = np.ascontiguousarray(pixels, '<i2').tobytes()
    for key, value in changes.items():
        if value is None:
            delattr(data, key)
        else:
            setattr(data, key, value)
    data.save_as(path, enforce_file_format=True)


def dicom_folder(folder, shuffle=(3, 0, 5, 1, 4, 2)):
    folder.mkdir(exist_ok=True)
    for name, k in enumerate(shuffle):
        dicom_slice(folder / f'{name}.dcm', -20 + 2.5 * k, COUNTS[:, :, k].T)
    (folder / 'notes.txt').write_text('hello')
    return folder


def test_dicom_folder(tmp_path):
    v = read_volume(dicom_folder(tmp_path / 'ct'))
    np.testing.assert_allclose(v.data, COUNTS * 2 / 3000.0, rtol=1e-6)
    assert v.spacing == pytest.approx(SPACING)  # columns are x, rows y
    np.testing.assert_allclose(v.affine[:3, 3], [-7, -8, -20])
    assert np.diag(v.affine)[:3] == pytest.approx([-0.5, -1, 2.5])
    np.testing.assert_allclose(read_volume(tmp_path / 'ct', mu_water=0.02).data, 0.02 * COUNTS * 2 / 1000.0, rtol=1e-5)


def test_one_dicom_slice_takes_its_thickness(tmp_path):
    (tmp_path / 'ct').mkdir()
    dicom_slice(tmp_path / 'ct' / 'a', 0, COUNTS[:, :, 0].T)
    assert read_volume(tmp_path / 'ct').spacing == (0.5, 1, 9)


def test_slices_of_a_tilted_gantry_are_refused(tmp_path):
    """Each lies where its position says, a millimetre beside the one before; a volume would be sheared."""
    (tmp_path / 'ct').mkdir()
    for k in range(6):
        dicom_slice(tmp_path / 'ct' / f'{k}.dcm', 2.5 * k, COUNTS[:, :, k].T, ImagePositionPatient=[7, 8 + k, 2.5 * k])
    refused(tmp_path / 'ct', 'shifted sideways')


@pytest.mark.parametrize(
    'changes, match',
    [
        ({'ImagePositionPatient': [7, 8, -3.0]}, 'not evenly spaced'),
        ({'ImagePositionPatient': [7, 8, -10]}, 'not evenly spaced'),
        ({'SeriesInstanceUID': '9'}, '2 DICOM series'),
        ({'PixelSpacing': [1.0, 0.6]}, 'differs'),
        ({'Rows': 2}, 'differs'),
        ({'NumberOfFrames': 2}, 'differs'),
        ({'ImageOrientationPatient': [0, 1, 0, 1, 0, 0]}, 'differs'),
        ({'ImagePositionPatient': None}, 'lacks geometry'),
        ({'BitsAllocated': 7}, 'unreadable pixels'),
        ({'PixelData': b'12'}, 'unreadable pixels'),
    ],
)
def test_bad_dicom(tmp_path, changes, match):
    folder = dicom_folder(tmp_path / 'ct')
    dicom_slice(folder / 'extra', -5, COUNTS[:, :, 0].T, **changes)
    refused(folder, match)


def test_a_dicom_file_damaged_anywhere(tmp_path):
    (tmp_path / 'ct').mkdir()
    path = tmp_path / 'ct' / 'a'
    dicom_slice(path, 0, COUNTS[:, :, 0].T)
    content, read = path.read_bytes(), 0
    for at in range(128, len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ (0x01, 0x20, 0xFF)[at % 3]]) + content[at + 1 :])
        try:
            read_volume(tmp_path / 'ct')
            read += 1
        except InputError as error:
            assert len(brief(error)) < 300 and str(error).isprintable()
    assert read > 100  # most of the bytes say nothing about the volume


def test_a_deflated_dicom_file_is_not_unpacked(tmp_path):
    pydicom = needs('pydicom')
    folder = dicom_folder(tmp_path / 'ct')
    data = pydicom.dcmread(folder / '0.dcm')
    data.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
    data.save_as(folder / '0.dcm')
    refused(folder, '0.dcm: is a deflated DICOM file')


def test_values_beyond_float32(tmp_path):
    np.save(tmp_path / 'v.npy', COUNTS * 1e300)
    refused(tmp_path / 'v.npy', 'range of float32')


def test_a_header_of_numpy_that_claims_more_than_there_is(tmp_path):
    np.save(tmp_path / 'v.npy', COUNTS)
    content = (tmp_path / 'v.npy').read_bytes()
    path = tmp_path / 'w.npy'
    path.write_bytes(content.replace(b'(4, 5, 6), }' + b' ' * 20, b'(400000, 500000, 600000), }' + b' ' * 5))
    refused(path, 'cannot hold')
    with zipfile.ZipFile(tmp_path / 'w.npz', 'w') as archive:
        archive.write(path, 'a.npy')
    refused(tmp_path / 'w.npz', 'cannot hold')


def test_folders_and_names_without_a_volume(tmp_path):
    refused(tmp_path, 'neither DICOM nor TIFF')
    refused(tmp_path / 'a.dcm', 'folder of the series')
    refused(tmp_path / 'a.xyz', 'no such file')
    (tmp_path / 'a.xyz').touch()
    refused(tmp_path / 'a.xyz', 'not a known volume format')


@pytest.mark.parametrize('module, name', [('tifffile', 'v.tif'), ('pydicom', '')])
def test_missing_package_names_the_extra(tmp_path, monkeypatch, module, name):
    if name:
        (tmp_path / name).touch()
    monkeypatch.setitem(sys.modules, module, None)
    refused(tmp_path / name, r"pip install '.\[formats\]' in a checkout")


def test_readers_load_without_the_optional_packages():
    code = (
        'import sys;'
        "sys.modules.update(dict.fromkeys(['SimpleITK', 'pydicom', 'tifffile']));"
        'import lingo_mi.files.scans, lingo_mi.files.volumes, lingo_mi.files.ply'
    )
    subprocess.run([sys.executable, '-c', code], check=True)


def test_no_reader_imports_mitsuba():
    files = Path(volumes.__file__).parent
    for file in [*files.glob('*.py'), *(files.parent / 'geometry').glob('*.py')]:
        for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module or '']
                if isinstance(node, ast.ImportFrom)
                else []
            )
            assert not {'mitsuba', 'drjit'} & {name.split('.')[0] for name in names}, file.name


# ---- real data ---------------------------------------------------------------------------------------------


def test_real_chest():
    folder = os.environ.get('LINGO_MI_DATA')
    if not folder or not (Path(folder) / 'chest_lidc0314.nii.gz').exists():
        pytest.skip('LINGO_MI_DATA names no folder with chest_lidc0314.nii.gz')
    v = read_volume(Path(folder) / 'chest_lidc0314.nii.gz')
    assert v.data.shape == (256, 256, 275) and v.spacing == (1.5625, 1.5625, 1)
    assert v.data.min() == 0 and v.data.max() == pytest.approx((1876 + 1000) / 3000)
    assert v.unit == 'normalised'


def test_a_little_below_zero_is_noise(tmp_path):
    """Up to a tenth of the highest value, also where that is not 1."""
    values = np.where(COUNTS == 3, -0.15, COUNTS * (2.0 / 119) + 1e-3)
    assert read_array(tmp_path, values).data.min() <= 0
    np.save(tmp_path / 'v.npy', np.where(COUNTS == 3, -0.25, values))
    refused(tmp_path / 'v.npy', 'Hounsfield')


@pytest.mark.parametrize('ratio, bytes_a_voxel', [(1, 8), (1000, 12)])
def test_memory_that_an_array_of_a_file_needs(tmp_path, monkeypatch, ratio, bytes_a_voxel):
    """float32 twice, and its own bytes where they are unpacked first."""
    asked = []
    monkeypatch.setattr(voxels, 'require_room', lambda size, *_: asked.append(size))
    (tmp_path / 'v').write_bytes(bytes(480))
    assert voxels.require_claim(tmp_path / 'v', SHAPE, np.dtype('f4'), ratio) == 480
    assert asked == [120 * bytes_a_voxel]


def test_what_follows_an_array_is_read_only_where_asked():
    content = bytes(120 + voxels._CHUNK + 1)
    assert len(voxels.read_exactly(io.BytesIO(content), 'v', 120)) == 120
    voxels.require_end(io.BytesIO(content[121:]), 'v')
    with pytest.raises(InputError, match='more data follow'):
        voxels.require_end(io.BytesIO(content[120:]), 'v')
