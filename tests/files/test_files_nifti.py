"""NIfTI and Analyze: as nibabel reads them, and headers that lie."""

import gzip
import struct
import tracemalloc

import nibabel
import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.nifti import read_nifti

SHAPE = (4, 5, 6)
VALUES = np.random.default_rng(0).integers(-50, 100, SHAPE)
AFFINE = np.array([[-0.5, 0, 0, 7], [0, 0, 2.5, 8], [0, 1, 0, 9], [0, 0, 0, 1.0]])


@pytest.mark.parametrize('kind', ['Nifti1Image', 'Nifti2Image', 'Nifti1Pair', 'Nifti2Pair', 'Spm2AnalyzeImage'])
@pytest.mark.parametrize('dtype, slope', [('i2', 1), ('>i2', 0.25), ('u1', 3), ('>f4', 1), ('f8', 1), ('i4', 1e-3)])
def test_as_nibabel_reads_it(tmp_path, kind, dtype, slope):
    if kind.startswith('Spm') and dtype in ('u1', '>i2'):
        pytest.skip('Analyze has no such type')
    image_class = getattr(nibabel, kind, None) or nibabel.spm2analyze.Spm2AnalyzeImage
    image = image_class(
        np.abs(VALUES).astype(dtype), AFFINE, image_class.header_class(endianness=dtype[0] if '>' in dtype else '<')
    )
    image.set_data_dtype(dtype)
    image.header.set_slope_inter(slope, 0)
    single = kind.endswith('Image') and not kind.startswith('Spm')
    for name in ('v.nii', 'v.nii.gz') if single else ('v.img', 'v.hdr'):
        nibabel.save(image, tmp_path / name)
        (tmp_path / 'v.mat').unlink(missing_ok=True)
        expected = nibabel.load(tmp_path / name)
        data, affine, _ = read_nifti(tmp_path / name)
        wanted = np.asanyarray(expected.dataobj)
        assert data.dtype == wanted.dtype
        np.testing.assert_array_equal(data, wanted)
        np.testing.assert_allclose(affine, expected.affine)


def claiming(path, shape, content=b'', dtype='f4', **fields):
    header = nibabel.Nifti1Header()
    header.set_data_dtype(dtype)
    header['dim'][: len(shape) + 1] = [len(shape), *shape]
    header['vox_offset'] = 352
    for name, value in fields.items():
        header[name] = value
    with gzip.open(path, 'wb') if path.suffix == '.gz' else open(path, 'wb') as stream:
        stream.write(header.binaryblock + bytes(4) + content)
    return path


@pytest.mark.parametrize('name', ['v.nii', 'v.nii.gz'])
@pytest.mark.parametrize('shape', [(1200, 1200, 1200), (32767,) * 7, (-4, 5, 6), (0, 5, 6), (4, 5, 6)])
def test_a_header_that_claims_more_than_there_is(tmp_path, name, shape):
    path = claiming(tmp_path / name, shape)
    tracemalloc.start()
    with pytest.raises(InputError, match='claims|too early'):
        read_nifti(path)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_extensions_and_what_follows_are_not_unpacked(tmp_path):
    """Less than a hundred kilobytes would unpack to tens of megabytes."""
    content = np.ones(SHAPE, np.float32).tobytes()
    read_nifti(claiming(tmp_path / 'v.nii.gz', SHAPE, content))
    for path in (
        claiming(tmp_path / 'after.nii.gz', SHAPE, content + bytes(30 << 20)),
        claiming(tmp_path / 'before.nii.gz', SHAPE, bytes(30 << 20), vox_offset=2**40),
    ):
        tracemalloc.start()
        with pytest.raises(InputError, match='more data follow|cannot hold'):
            read_nifti(path)
        assert tracemalloc.get_traced_memory()[1] < 10e6
        tracemalloc.stop()


@pytest.mark.parametrize('name', ['v.nii', 'v.nii.gz'])
def test_an_extension_is_passed_over(tmp_path, name):
    """An extension may have thirty megabytes, which a file of kilobytes can hold."""
    start = 30 << 20 if name.endswith('.gz') else 1 << 10
    size = start - 352
    extension = struct.pack('<ii', size, 4) + bytes(size - 8)
    content = np.arange(120, dtype=np.float32).tobytes()
    path = claiming(tmp_path / name, SHAPE, extension + content, vox_offset=start)
    tracemalloc.start()
    data, _, _ = read_nifti(path)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()
    np.testing.assert_array_equal(data.ravel('F'), np.arange(120))


@pytest.mark.parametrize('fields', [dict(vox_offset=np.nan), dict(vox_offset=-1), dict(datatype=128), dict(dim=9)])
def test_fields_that_make_no_sense(tmp_path, fields):
    path = claiming(tmp_path / 'v.nii', SHAPE, bytes(480), **fields)
    try:
        data, _, _ = read_nifti(path)
    except InputError as error:
        assert '\n' not in str(error)
    else:  # a colour, which the caller refuses
        assert data.dtype.kind == 'V'
