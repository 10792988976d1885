"""MetaImage without a library: as SimpleITK reads it, and headers that lie."""

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.itk import read_metaimage

SHAPE = (4, 5, 6)
VALUES = np.random.default_rng(0).integers(0, 100, SHAPE)
BODY = VALUES.astype('u1').tobytes('F')
HEADER = dict(
    ObjectType='Image', NDims='3', BinaryData='True', DimSize='4 5 6', ElementType='MET_UCHAR', ElementDataFile='LOCAL'
)


def written(path, body=BODY, **changes):
    fields = {**HEADER, **changes}
    fields['ElementDataFile'] = fields.pop('ElementDataFile')  # the last
    text = '\n'.join(f'{name} = {value}' for name, value in fields.items() if value is not None)
    path.write_bytes(text.encode('latin1') + b'\n' + body)
    return path


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        read_metaimage(path)
    assert '\n' not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize('suffix', ['mha', 'mhd'])
@pytest.mark.parametrize('compressed', [False, True])
@pytest.mark.parametrize('dtype', ['i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'i8', 'u8', 'f4', 'f8'])
def test_as_simpleitk_writes_it(tmp_path, suffix, compressed, dtype):
    sitk = pytest.importorskip('SimpleITK')
    image = sitk.GetImageFromArray(VALUES.astype(dtype).transpose(2, 1, 0))
    image.SetSpacing((0.5, 1, 2.5))
    image.SetOrigin((7, 8, 9))
    image.SetDirection((0, -1, 0, 0.6, 0, 0.8, -0.8, 0, 0.6))
    path = tmp_path / f'v.{suffix}'
    sitk.WriteImage(image, str(path), compressed)
    data, affine = read_metaimage(path)
    assert data.dtype == dtype
    np.testing.assert_array_equal(data, VALUES)
    np.testing.assert_allclose(affine[:3, :3], np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing())
    np.testing.assert_allclose(affine[:, 3], [7, 8, 9, 1])


@pytest.mark.parametrize('word', ['True', 'true', 'T', '1'])
def test_words_for_true(tmp_path, word):
    data, _ = read_metaimage(written(tmp_path / 'v.mha', BinaryData=word))
    np.testing.assert_array_equal(data, VALUES)


@pytest.mark.parametrize('direction', ['TransformMatrix', 'Rotation', 'Orientation'])
@pytest.mark.parametrize('place', ['Offset', 'Position', 'Origin'])
def test_as_simpleitk_reads_it(tmp_path, direction, place):
    """Fields that SimpleITK does not write are read as it reads them, and so are other names of its fields."""
    sitk = pytest.importorskip('SimpleITK')
    path = written(
        tmp_path / 'v.mha',
        VALUES.astype('>i2').tobytes('F'),
        ElementType='MET_SHORT',
        ElementByteOrderMSB='True',
        ElementSpacing='1 2 3',
        Comment='a = b',
        **{direction: '1 0 0 0 0 1 0 -1 0', place: '-1 0 4e1'},
    )
    image = sitk.ReadImage(str(path))
    data, affine = read_metaimage(path)
    np.testing.assert_array_equal(data, sitk.GetArrayFromImage(image).transpose(2, 1, 0))
    np.testing.assert_allclose(affine[:3, :3], np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing())
    np.testing.assert_allclose(affine[:3, 3], image.GetOrigin())


def test_what_the_header_leaves_out(tmp_path):
    """If the header does not say, voxels are 1 mm along the axes and the first is at the origin, as in SimpleITK."""
    np.testing.assert_array_equal(read_metaimage(written(tmp_path / 'v.mha'))[1], np.eye(4))


def test_sizes_in_the_place_of_spacings_and_other_units(tmp_path):
    _, affine = read_metaimage(written(tmp_path / 'v.mha', ElementSize='1 2 3'))
    np.testing.assert_allclose(affine, np.diag([1, 2, 3, 1]))
    _, affine = read_metaimage(
        written(tmp_path / 'v.mha', ElementSpacing='20 20 40', Offset='100 0 0', DistanceUnits='um')
    )
    np.testing.assert_allclose(affine[:3, :3], np.diag([0.02, 0.02, 0.04]))
    np.testing.assert_allclose(affine[:3, 3], [0.1, 0, 0])
    refused(written(tmp_path / 'v.mha', DistanceUnits='inch'), 'DistanceUnits must be one of')


def test_voxels_at_the_end_and_below(tmp_path):
    (tmp_path / 'below').mkdir()
    (tmp_path / 'below' / 'v.raw').write_bytes(b'skipped' + VALUES.astype('u1').tobytes('F'))
    path = written(tmp_path / 'v.mhd', b'', HeaderSize=-1, ElementDataFile='below/v.raw')
    np.testing.assert_array_equal(read_metaimage(path)[0], VALUES)
    written(tmp_path / 'v.mhd', b'', HeaderSize=7, ElementDataFile='below/v.raw')
    np.testing.assert_array_equal(read_metaimage(path)[0], VALUES)


@pytest.mark.parametrize('n', ['4294967296', '999999999999', '-1', '100', '1e400', 'nan', '', '3 3', 'x' * 5000])
def test_wrong_numbers_of_dimensions(tmp_path, n):
    """They have crashed a library that trusted them."""
    refused(written(tmp_path / 'v.mha', NDims=n), 'NDims|dimensions')


@pytest.mark.parametrize(
    'changes, match',
    [
        (dict(ElementDataFile='%n%n%s%s.raw 1 2 1'), 'several files'),
        (dict(ElementDataFile='LIST'), 'several files'),
        (dict(ElementDataFile='/etc/hostname'), 'beside it'),
        (dict(ElementDataFile='../../v.raw'), 'beside it'),
        (dict(ElementDataFile='below/../../v.raw'), 'beside it'),
        (dict(ElementDataFile=''), 'beside it'),
        (dict(ElementDataFile='v\0.raw'), 'not a name of a file'),
        (dict(ElementDataFile='.'), 'a folder'),
        (dict(DimSize='4 5 7'), 'cannot hold'),
        (dict(DimSize='99999999 99999999 99999999'), 'cannot hold'),
        (dict(DimSize='4 5 1e300'), 'cannot hold'),
        (dict(DimSize='4 5 0'), 'DimSize'),
        (dict(DimSize='4 5'), 'DimSize'),
        (dict(DimSize=None), 'DimSize'),
        (dict(ElementType='MET_STRING'), 'ElementType'),
        (dict(ElementNumberOfChannels='3'), '3 values a voxel'),
        (dict(NDims=None), 'has 0 dimensions'),
        (dict(BinaryData='False'), 'BinaryData'),
        (dict(HeaderSize='-2'), 'HeaderSize'),
        (dict(HeaderSize='9' * 300), 'cannot hold'),
        (dict(HeaderSize='inf'), 'HeaderSize'),
        (dict(CompressedData='True'), 'unpacked'),
        (dict(CompressedData='True', HeaderSize='1e19'), 'begin after its end'),
        (dict(ElementSpacing='1 nan 1'), 'ElementSpacing'),
        (dict(TransformMatrix='1 0 0'), 'TransformMatrix'),
    ],
)
def test_headers_that_lie(tmp_path, changes, match):
    refused(written(tmp_path / 'v.mha', **changes), match)


def test_no_end_of_the_header(tmp_path):
    (tmp_path / 'v.mha').write_bytes(b'NDims = 3\n' * 20000)
    refused(tmp_path / 'v.mha', 'no end')


@pytest.mark.parametrize(
    'name, dtype',
    [
        *(('MET_CHAR', 'i1'), ('MET_UCHAR', 'u1'), ('MET_SHORT', 'i2'), ('MET_USHORT', 'u2'), ('MET_INT', 'i4')),
        *(('MET_UINT', 'u4'), ('MET_LONG', 'i4'), ('MET_ULONG', 'u4'), ('MET_LONG_LONG', 'i8')),
        *(('MET_ULONG_LONG', 'u8'), ('MET_FLOAT', 'f4'), ('MET_DOUBLE', 'f8')),
    ],
)
def test_types(tmp_path, name, dtype):
    """The types of the format's description are read; its long has 4 bytes."""
    data, _ = read_metaimage(written(tmp_path / 'v.mha', VALUES.astype(dtype).tobytes('F'), ElementType=name))
    assert data.dtype == dtype
    np.testing.assert_array_equal(data, VALUES)
