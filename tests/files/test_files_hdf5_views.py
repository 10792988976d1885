"""Projections in an HDF5 file: read where they are needed, and one line for what is missing."""

import pickle
import shutil

import numpy as np
import pytest
import yaml

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.files import hdf5_views
from lingo_mi.files.scans import read_scan
from lingo_mi.reconstruction import FDK
from lingo_mi.reconstruction.run import run_in_slabs

h5py = pytest.importorskip('h5py')
GEOMETRY = dict(DSO=500, DSD=800, nDetector=[6, 8], dDetector=[2, 2], nVoxel=[8, 8, 8], dVoxel=[1, 1, 1])
VALUES = np.random.default_rng(0).random((10, 6, 8), np.float32)


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / 'scan.h5', **{'exchange/data': VALUES})


def write(path, geometry=(), **data):
    with h5py.File(path, 'w') as file:
        for name, values in data.items():
            file.create_dataset(name, data=values, chunks=(4, *values.shape[1:]), compression='gzip')
    path.with_suffix('.yml').write_text(yaml.safe_dump(GEOMETRY | dict(geometry)))
    return path


def refused(words, do):
    with pytest.raises(InputError, match=words) as error:
        do()
    assert 'scan.' in str(error.value) and '\n' not in str(error.value)


def test_some_views(path, monkeypatch):
    scan = read_scan(path).train
    np.testing.assert_array_equal(scan.views([7, 2, 2, 9]), VALUES[[7, 2, 2, 9]])
    np.testing.assert_array_equal(scan.subset(slice(8, None, -3)).views([2, 0]), VALUES[[2, 8]])
    assert 'projections' not in vars(scan) and str(path) in repr(scan)
    monkeypatch.setattr('lingo_mi.scan.PIECE', 4)
    there = pickle.loads(pickle.dumps(scan))
    np.testing.assert_array_equal(np.concatenate(list(there.pieces())), VALUES)
    np.testing.assert_array_equal(scan.projections, VALUES)  # all of them, where a caller wants so
    assert lm.load(path, views=5).test.views(slice(None)).shape == (5, 6, 8)


def test_a_volume_in_slabs_reads_some_views_at_a_time(path, tmp_path, monkeypatch):
    numbers, read = [], hdf5_views.HDF5Views._read
    monkeypatch.setattr(hdf5_views.HDF5Views, '_read', lambda self, some: numbers.append(len(some)) or read(self, some))
    monkeypatch.setattr('lingo_mi.scan.PIECE', 4)
    monkeypatch.setattr('lingo_mi.reconstruction.fdk.BATCH', 4)
    scan = read_scan(path).train
    run_in_slabs(scan, FDK(), tmp_path / 'found.nii', 4)
    assert 0 < max(numbers) <= 4 and 'projections' not in vars(scan)
    run_in_slabs(lm.Scan(scan.geometry, VALUES), FDK(), tmp_path / 'wanted.nii', 4)
    assert (tmp_path / 'found.nii').read_bytes() == (tmp_path / 'wanted.nii').read_bytes()


@pytest.mark.parametrize('dtype', ['>f8', 'u2', 'f2'])
def test_a_dataset_that_the_geometry_names(tmp_path, dtype):
    values = (100 * VALUES).astype(dtype)
    path = write(tmp_path / 'scan.nxs', dict(dataset='/entry/data'), **{'entry/data': values})
    np.testing.assert_array_equal(read_scan(path).train.views([3]), values[[3]].astype('f4'))
    shutil.move(path.with_suffix('.yml'), tmp_path / 'other.yml')
    assert len(read_scan(path, tmp_path / 'other.yml').train) == 10
    refused('holds raw frames; make a scan of them', lambda: read_scan(path))


def test_a_file_is_cut_off(path):
    scan, content = read_scan(path).train, path.read_bytes()
    for size in (len(content) // 2, 100, 0):
        path.write_bytes(content[:size])
        refused('scan.h5: is cut off, damaged or not HDF5', lambda: read_scan(path))
        refused('scan.h5: is cut off, damaged or not HDF5', lambda: scan.views([0]))


def test_a_chunk_is_damaged(path):
    content = path.read_bytes()
    with h5py.File(path) as file:
        chunk = file['exchange/data'].id.get_chunk_info(1)
    damaged = bytearray(content)
    damaged[chunk.byte_offset : chunk.byte_offset + chunk.size] = b'x' * chunk.size
    path.write_bytes(damaged)
    scan = read_scan(path).train
    assert scan.views([0]).shape == (1, 6, 8)
    refused('scan.h5: the views 4 to 6 are damaged', lambda: scan.views([6, 4]))


def test_the_index_of_the_chunks_is_damaged(path):
    """Such a file gives one line; mutation found the case."""
    content = path.read_bytes()
    assert content.count(b'TREE') > 1
    path.write_bytes(content.replace(b'TREE\x01', b'TREF\x01'))  # of chunks; a tree of groups has the type 0
    refused('scan.h5', lambda: read_scan(path).train.views([0]))


def test_views_that_were_never_written(path):
    with h5py.File(path, 'w') as file:
        data = file.create_dataset('exchange/data', (10, 6, 8), 'f4', chunks=(4, 6, 8))
        data[:8] = 1
    refused('exchange/data lacks views that were never written', lambda: read_scan(path))


def test_bad_input(path, tmp_path):
    def rewritten(data, words, **geometry):
        write(path, geometry, **data)
        refused(words, lambda: read_scan(path))

    rewritten({'entry/data': VALUES}, 'has no dataset exchange/data in this file; name the dataset')
    rewritten({'a': VALUES}, 'has no dataset /b in this file', dataset='/b')
    rewritten({'a': VALUES}, 'dataset must be the name of a dataset, not 3', dataset=3)
    rewritten({'exchange/data': VALUES, 'exchange/data_white': VALUES}, 'raw frames .* lingo-mi import')
    rewritten({'exchange/data': VALUES[0]}, r'values of the shape \[6, 8\]; real numbers .n, v, u. are needed')
    rewritten({'exchange/data': VALUES.astype(complex)}, 'real numbers .n, v, u. are needed')
    rewritten({'exchange/data': VALUES}, 'are line integrals: leave out input', input='intensity', I0=2.0)
    rewritten({'exchange/data': VALUES}, r'have the shape \(10, 6, 8\)', nDetector=[6, 9])
    values = VALUES.copy()
    values[5, 0, 0] = np.nan
    write(path, **{'exchange/data': values})
    refused('view 5 holds NaN', lambda: read_scan(path).train.views([4, 5]))
    shutil.copy(path, tmp_path / 'elsewhere.h5')
    with h5py.File(path, 'w') as file:
        file['exchange/data'] = h5py.ExternalLink('elsewhere.h5', '/exchange/data')
    refused('has no dataset exchange/data in this file', lambda: read_scan(path))
    with h5py.File(path, 'w') as file:
        layout = h5py.VirtualLayout((10, 6, 8), 'f4')
        layout[:] = h5py.VirtualSource(str(tmp_path / 'elsewhere.h5'), 'exchange/data', (10, 6, 8))
        file.create_virtual_dataset('exchange/data', layout)
    refused('lies in other files', lambda: read_scan(path))
