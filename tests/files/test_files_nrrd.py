"""NRRD without a library: as SimpleITK reads it, and headers that lie."""

import bz2
import gzip

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.itk import read_nrrd

SHAPE = (4, 5, 6)
VALUES = np.random.default_rng(0).integers(0, 100, SHAPE)
BODY = VALUES.astype('u1').tobytes('F')
HEADER = {'type': 'uchar', 'dimension': '3', 'sizes': '4 5 6', 'encoding': 'raw'}


def written(path, body=BODY, changes=(), magic='NRRD0004'):
    fields = {**HEADER, **dict(changes)}
    text = '\n'.join([magic, '# a comment: none', *(f'{name}: {value}' for name, value in fields.items() if value)])
    path.write_bytes(text.encode('latin1') + b'\n\n' + body)
    return path


@pytest.mark.parametrize('suffix', ['nrrd', 'nhdr'])
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
    data, affine = read_nrrd(path)
    assert data.dtype == dtype
    np.testing.assert_array_equal(data, VALUES)
    np.testing.assert_allclose(affine[:3, :3], np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing())
    np.testing.assert_allclose(affine[:, 3], [7, 8, 9, 1])


@pytest.mark.parametrize(
    'space', ['RAS', 'left-anterior-superior', 'LPS', 'right-anterior-superior', '3D-right-handed', None]
)
def test_spaces_as_simpleitk_reads_them(tmp_path, space):
    sitk = pytest.importorskip('SimpleITK')
    changes = {'space': space} if space else {'space dimension': '3'}
    changes |= {'space directions': '(0,2,0) (-0.5,0,0) (0,0,3)', 'space origin': '(7,8,-9)'}
    image = sitk.ReadImage(str(written(tmp_path / 'v.nrrd', changes=changes)))
    data, affine = read_nrrd(tmp_path / 'v.nrrd')
    np.testing.assert_array_equal(data, sitk.GetArrayFromImage(image).transpose(2, 1, 0))
    np.testing.assert_allclose(affine[:3, :3], np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing())
    np.testing.assert_allclose(affine[:3, 3], image.GetOrigin())


def test_packings_and_byte_orders(tmp_path):
    for encoding, pack in (('raw', bytes), ('gz', gzip.compress), ('bzip2', bz2.compress)):
        body = pack(VALUES.astype('>i2').tobytes('F'))
        path = written(tmp_path / 'v.nrrd', body, dict(type='int16', endian='big', encoding=encoding, spacings='1 2 3'))
        data, affine = read_nrrd(path)
        np.testing.assert_array_equal(data, VALUES)
        np.testing.assert_array_equal(np.diag(affine), [1, 2, 3, 1])
        with pytest.raises(InputError, match='truncated|unpacked'):
            path.write_bytes(path.read_bytes()[:-5])
            read_nrrd(path)


@pytest.mark.parametrize(
    'changes, match',
    [
        ({'data file': '/etc/hostname'}, 'beside it'),
        ({'datafile': '../../../etc/hostname'}, 'beside it'),
        ({'data file': 'LIST'}, 'several files'),
        ({'data file': '%n%s.raw 1 2 1'}, 'several files'),
        ({'data file': 'gone.raw'}, 'no such file'),
        ({'dimension': '4294967296'}, 'dimensions'),
        ({'dimension': '-1'}, 'dimensions'),
        ({'dimension': ''}, 'has 0 dimensions'),
        ({'dimension': '1e400'}, 'dimension'),
        ({'kinds': 'vector domain domain'}, 'dimensions'),
        ({'sizes': '4 5 99999999999'}, 'cannot hold'),
        ({'sizes': '4 5 -6'}, 'sizes'),
        ({'sizes': '4 5'}, 'sizes'),
        ({'sizes': '4 5 6.5'}, 'sizes'),
        ({'type': 'block'}, 'type must be'),
        ({'encoding': 'ascii'}, 'encoding must be'),
        ({'encoding': 'gzip'}, 'unpacked'),
        ({'encoding': 'bz2'}, 'unpacked'),
        ({'encoding': 'bz2', 'sizes': '99999999 99999999 9999'}, 'GiB of memory'),
        ({'endian': 'middle'}, 'endian'),
        ({'byte skip': '-2'}, 'skip'),
        ({'byte skip': '9' * 300}, 'skip'),
        ({'line skip': '1'}, 'skip'),
        ({'space directions': 'none (1,0,0) (0,1,0)'}, 'space directions'),
        ({'spacings': '1 1 nan'}, 'spacings'),
        ({'axis mins': '0 0 0'}, 'axis mins'),
    ],
)
def test_headers_that_lie(tmp_path, changes, match):
    with pytest.raises(InputError, match=match) as caught:
        read_nrrd(written(tmp_path / 'v.nrrd', changes=changes))
    assert '\n' not in str(caught.value) and len(str(caught.value)) < 300


def test_no_header(tmp_path):
    for content in (b'', b'NRRD', b'NRRD0004', b'NRRD0004\n' + b'a: b\n' * 40000):
        (tmp_path / 'v.nrrd').write_bytes(content)
        with pytest.raises(InputError):
            read_nrrd(tmp_path / 'v.nrrd')


@pytest.mark.parametrize('space', [False, True])
def test_units_of_length(tmp_path, space):
    changes = {'space': 'LPS', 'space directions': '(20,0,0) (0,20,0) (0,0,40)', 'space origin': '(100,0,0)'}
    changes |= {'space units': '"um" "um" "um"'}
    if not space:
        changes = {'spacings': '20 20 40', 'units': '"um" "um" "um"'}
    _, affine = read_nrrd(written(tmp_path / 'v.nrrd', changes=changes))
    np.testing.assert_allclose(affine[:3, :3], np.diag([0.02, 0.02, 0.04]))
    np.testing.assert_allclose(affine[:3, 3], [0.1 if space else 0, 0, 0])
    for units in ('"inch" "inch" "inch"', '"mm" "mm" "um"'):
        name = 'space units' if space else 'units'
        with pytest.raises(InputError, match='units must be one of'):
            read_nrrd(written(tmp_path / 'v.nrrd', changes=changes | {name: units}))


def test_what_the_header_leaves_out(tmp_path):
    """If the header does not say, voxels are 1 mm and the first is at the origin; a kind may be none."""
    np.testing.assert_array_equal(read_nrrd(written(tmp_path / 'v.nrrd'))[1], np.eye(4))
    changes = {'space': 'LPS', 'space directions': '(2,0,0) (0,3,0) (0,0,4)', 'kinds': 'none domain ???'}
    np.testing.assert_array_equal(read_nrrd(written(tmp_path / 'v.nrrd', changes=changes))[1], np.diag([2, 3, 4, 1]))


# https://teem.sourceforge.net/nrrd/format.html#type
NAMES_OF_TYPES = {
    'i1': ['signed char', 'int8', 'int8_t'],
    'u1': ['uchar', 'unsigned char', 'uint8', 'uint8_t'],
    'i2': ['short', 'short int', 'signed short', 'signed short int', 'int16', 'int16_t'],
    'u2': ['ushort', 'unsigned short', 'unsigned short int', 'uint16', 'uint16_t'],
    'i4': ['int', 'signed int', 'int32', 'int32_t'],
    'u4': ['uint', 'unsigned int', 'uint32', 'uint32_t'],
    'i8': ['longlong', 'long long', 'long long int', 'signed long long', 'signed long long int', 'int64', 'int64_t'],
    'u8': ['ulonglong', 'unsigned long long', 'unsigned long long int', 'uint64', 'uint64_t'],
    'f4': ['float'],
    'f8': ['double'],
}


@pytest.mark.parametrize('dtype', NAMES_OF_TYPES)
def test_types(tmp_path, dtype):
    body = VALUES.astype(dtype).tobytes('F')
    for name in NAMES_OF_TYPES[dtype]:
        data, _ = read_nrrd(written(tmp_path / 'v.nrrd', body, {'type': name, 'endian': 'little'}))
        assert data.dtype == dtype, name
        np.testing.assert_array_equal(data, VALUES)
