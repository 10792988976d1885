"""CT volumes in one file: every format with asymmetric data, and bad input."""

import ast
import builtins
import os
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from helpers.volume_files import COUNTS, HU, SHAPE, SPACING, needs, read_array, refused
from lingo_mi.common.errors import InputError
from lingo_mi.files import volumes
from lingo_mi.files.volumes import centred_affine, git_blob_sha1, read_volume, write_volume
from lingo_mi.geometry.grid import Grid
from lingo_mi.storage import file_access

# ---- NIfTI -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('suffix', ['.nii', '.nii.gz'])
@pytest.mark.parametrize('scale', [1, 700])
def test_our_nifti_round_trips_unchanged(tmp_path, suffix, scale):
    """This holds also for values that would be divided by their maximum or clipped in a stranger's file."""
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
    zipped.write_bytes(raw[:-8] + bytes([raw[-8] ^ 1]) + raw[-7:])  # the checksum, which nibabel does not reach
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


# ---- NRRD, MetaImage --------------------------------------------------------------------------


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
