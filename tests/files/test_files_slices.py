"""Volumes in slices: TIFF stacks and DICOM series."""

import struct
import time

import numpy as np
import pytest

from helpers.volume_files import COUNTS, SPACING, needs, refused
from lingo_mi.common.errors import InputError, brief
from lingo_mi.files.volumes import read_volume

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
