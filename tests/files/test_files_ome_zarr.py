"""OME-Zarr read: what the package writes, what others write, and what is refused."""

import json
import shutil

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.files.slabs import write_slabs
from lingo_mi.files.volumes import read_volume

zarr = pytest.importorskip('zarr')
SCALE = dict(type='scale', scale=[2.0, 1.5, 1.0])


@pytest.fixture
def volume():
    return np.random.default_rng(0).random((7, 6, 5), np.float32) + 1


def image(folder, array, axes='zyx', version=3, unit='millimeter', transformations=(SCALE,), everywhere=(), **options):
    """An OME-Zarr as others write it."""
    group = zarr.open_group(str(folder), mode='w', zarr_format=version)
    stored = group.create_array('0', shape=array.shape, chunks=array.shape, dtype=array.dtype, **options)
    stored[...] = array
    names = [dict(name=a, type='space', unit=unit) if a in 'xyz' else dict(name=a, type='channel') for a in axes]
    multiscales = [dict(axes=names, datasets=[dict(path='0', coordinateTransformations=list(transformations))])]
    if everywhere:
        multiscales[0]['coordinateTransformations'] = list(everywhere)
    group.attrs.update(
        dict(ome=dict(version='0.5', multiscales=multiscales)) if version == 3 else dict(multiscales=multiscales)
    )
    return folder


def test_what_is_written_is_read_unchanged(tmp_path, volume):
    g = lm.Geometry.cone(
        DSO=300,
        DSD=450,
        nDetector=9,
        dDetector=4,
        nVoxel=volume.shape,
        dVoxel=(1, 1.5, 2),
        offOrigin=(3, -4, 5),
        angles=[0.0],
    )
    write_slabs(tmp_path / 'v.ome.zarr', g.grid, [volume])
    read = read_volume(tmp_path / 'v.ome.zarr')
    np.testing.assert_array_equal(read.data, volume)
    assert read.unit == 'density per mm' and read.spacing == (1, 1.5, 2)
    np.testing.assert_allclose(read.affine[:3, 3], g.grid.first_voxel)


@pytest.mark.parametrize('version', [2, 3])
def test_of_others(tmp_path, volume, version):
    """Densities follow the rules of any file, lengths become mm, and an axis of one channel is dropped."""
    shift = dict(type='translation', translation=[0.0, 40.0, 30.0, 20.0])
    steps = dict(type='scale', scale=[1.0, 2000.0, 1500.0, 1000.0])
    whole = (1000 * volume.transpose(2, 1, 0)[None]).astype(np.uint16)
    folder = image(tmp_path / 'v.zarr', whole, 'czyx', version, 'micrometer', (steps, shift))
    read = read_volume(folder)
    np.testing.assert_allclose(read.data, whole[0].transpose(2, 1, 0) / whole.max(), rtol=1e-6)
    assert read.spacing == (1, 1.5, 2) and read.unit == 'normalised'
    np.testing.assert_allclose(read.affine[:3, 3], [0.02, 0.03, 0.04])


def test_transformations_of_all_levels_come_after_those_of_one(tmp_path, volume):
    shift = dict(type='translation', translation=[4.0, 5.0, 6.0])
    read = read_volume(
        image(
            tmp_path / 'v.zarr',
            volume.transpose(2, 1, 0),
            transformations=(SCALE, shift),
            everywhere=[dict(type='scale', scale=[0.05, 0.1, 0.2])],
        )
    )
    np.testing.assert_allclose(read.spacing, (0.2, 0.15, 0.1))
    np.testing.assert_allclose(read.affine[:3, 3], [1.2, 0.5, 0.2])


def test_other_axes(tmp_path, volume):
    read = read_volume(image(tmp_path / 'v.zarr', volume, 'xyz'))
    np.testing.assert_allclose(read.data, volume / volume.max(), rtol=1e-6)
    assert read.spacing == (2, 1.5, 1)


@pytest.mark.parametrize(
    'options, says',
    [
        (dict(axes='tyx'), 'has the axes t y x'),
        (dict(unit='furlong'), 'unit of length unknown'),
        (dict(transformations=[dict(type='scale', scale=[1, 1])]), 'has no image in the form'),
        (dict(transformations=[dict(type='scale', scale=[1, 1, float('inf')])]), 'has no image in the form'),
        (dict(transformations=[dict(type='scale', scale=[1, 1, 10**400])]), 'has no image in the form'),
        (dict(transformations=[dict(type='affine', affine=[1])]), 'has no image in the form'),
    ],
)
def test_another_image(tmp_path, volume, options, says):
    with pytest.raises(InputError, match=says):
        read_volume(image(tmp_path / 'v.zarr', volume.transpose(2, 1, 0), **options))


def test_several_channels(tmp_path, volume):
    with pytest.raises(InputError, match='a single volume is needed'):
        read_volume(image(tmp_path / 'v.zarr', np.stack([volume, volume]), 'czyx', transformations=[]))


def damage(folder, name, change):
    path = folder / name
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def test_codecs_that_run_code_are_refused(tmp_path, volume):
    """A filter of Zarr 2 named pickle would load any object, of a stranger's choice."""
    folder = image(tmp_path / 'v.zarr', volume, version=2)
    damage(folder, '0/.zarray', lambda header: header.update(filters=[dict(id='pickle', protocol=5)]))
    with pytest.raises(InputError, match="packed with 'pickle'"):
        read_volume(folder)
    damage(folder, '0/.zarray', lambda header: header.update(filters=[dict(name='zstd', id='pickle', protocol=5)]))
    with pytest.raises(InputError, match="packed with 'pickle'"):
        read_volume(folder)
    inner = [dict(name='sharding_indexed', configuration=dict(codecs=[dict(name='numcodecs.pickle')]))]
    folder = image(tmp_path / 'w.zarr', volume)
    damage(folder, '0/zarr.json', lambda header: header.update(codecs=inner))
    with pytest.raises(InputError, match="packed with 'numcodecs.pickle'"):
        read_volume(folder)


@pytest.mark.parametrize('path', ['../v', '/etc', '', '1', 'a/../../v'])
def test_levels_stay_in_the_folder(tmp_path, volume, path):
    folder = image(tmp_path / 'v.zarr', volume)
    shutil.copytree(folder / '0', tmp_path / 'v')  # an array that could be read
    damage(folder, 'zarr.json', lambda g: g['attributes']['ome']['multiscales'][0]['datasets'][0].update(path=path))
    with pytest.raises(InputError, match='no such file' if path == '1' else 'has no image in the form'):
        read_volume(folder)


@pytest.mark.parametrize('name', ['zarr.json', '0/zarr.json', '0/c/0/0/0'])
@pytest.mark.parametrize(
    'content', [b'', b'{', b'[]', b'{}', b'\0' * 100, b'{"attributes": {"ome": {"multiscales": [3]}}}']
)
def test_damaged(tmp_path, volume, name, content):
    folder = image(tmp_path / 'v.zarr', volume.transpose(2, 1, 0))
    (folder / name).write_bytes(content)
    with pytest.raises(InputError, match='v.zarr'):
        read_volume(folder)


def test_a_claim_that_no_memory_holds(tmp_path, volume):
    folder = image(tmp_path / 'v.zarr', volume)
    damage(folder, '0/zarr.json', lambda header: header.update(shape=[1 << 20] * 3))
    with pytest.raises(InputError, match='memory'):
        read_volume(folder)


def test_no_folder(tmp_path):
    (tmp_path / 'v.zarr').write_text('x')
    with pytest.raises(InputError, match='a file, not a folder'):
        read_volume(tmp_path / 'v.zarr')
    with pytest.raises(InputError, match='there is no such file'):
        read_volume(tmp_path / 'w.zarr')


def test_a_chunk_that_no_memory_holds(tmp_path, volume):
    """A chunk is unpacked whole, however small the array."""
    folder = image(tmp_path / 'v.zarr', volume)
    huge = dict(name='regular', configuration=dict(chunk_shape=[1 << 20] * 3))
    damage(folder, '0/zarr.json', lambda header: header.update(chunk_grid=huge))
    with pytest.raises(InputError, match='memory'):
        read_volume(folder)
