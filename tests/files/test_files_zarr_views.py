"""Projections in a Zarr array: read where they are needed, and one line for what is missing."""

import json
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.common.errors import InputError
from lingo_mi.files.scans import read_scan, write_scan
from lingo_mi.scan import Scan

zarr = pytest.importorskip('zarr')


@pytest.fixture
def scan():
    geometry = lm.Geometry.cone(
        DSO=500, DSD=800, nDetector=(6, 8), dDetector=2.0, nVoxel=8, dVoxel=2.0, angles=np.linspace(0, 6, 10)
    )
    return Scan(geometry, np.random.default_rng(0).random((10, 6, 8), np.float32))


@pytest.fixture
def path(scan, tmp_path):
    write_scan(tmp_path / 'scan.zarr', scan, 'zarr')
    return tmp_path / 'scan.zarr'


def test_what_was_written(scan, path):
    actual = read_scan(path).train
    np.testing.assert_array_equal(actual.views([7, 2]), scan.projections[[7, 2]])
    np.testing.assert_array_equal(actual.subset(slice(1, 9, 3)).views([2, 0]), scan.projections[[7, 1]])
    assert 'projections' not in vars(actual) and str(path) in repr(actual)
    there = pickle.loads(pickle.dumps(actual.on(scan.geometry.grid)))
    np.testing.assert_array_equal(np.concatenate(list(there.pieces())), scan.projections)
    assert actual.digest() == scan.digest()
    np.testing.assert_array_equal(actual.projections, scan.projections)  # all of them, where a caller wants so
    np.testing.assert_array_equal(replace(actual, effects=None).projections, scan.projections)
    assert lm.load(path, views=5).test.views(slice(None)).shape == (5, 6, 8)


def test_others_zarr_2(scan, path):
    shutil.rmtree(path)
    array = zarr.create_array(str(path), shape=(10, 6, 8), chunks=(3, 6, 4), dtype='float64', zarr_format=2)
    array[:] = scan.projections
    np.testing.assert_array_equal(read_scan(path).train.views([9]), scan.projections[[9]])


def refused(words, do):
    with pytest.raises(InputError, match=words) as error:
        do()
    assert 'scan.' in str(error.value) and '\n' not in str(error.value)


def test_a_chunk_is_missing(path):
    actual = read_scan(path).train
    (path / 'c' / '1' / '0' / '0').unlink()
    refused('scan.zarr: lacks a chunk of the views 4 to 7', lambda: read_scan(path))
    refused('scan.zarr: lacks a chunk of the views 4 to 7', lambda: actual.views([1, 5]))
    assert actual.views([9]).shape == (1, 6, 8)


def test_a_chunk_ends_early(path):
    file = path / 'c' / '2' / '0' / '0'
    file.write_bytes(file.read_bytes()[:100])
    actual = read_scan(path).train
    assert actual.views([0]).shape == (1, 6, 8)
    refused('scan.zarr: a chunk of the views 8 to 9 is cut off or damaged', lambda: actual.views([9, 8]))


def test_bad_input(scan, path):
    array = zarr.open_array(str(path))
    array[5, 0, 0] = np.nan
    refused('view 5 holds NaN', lambda: read_scan(path).train.views([4, 5]))
    geometry = path.with_suffix('.yml')
    words = geometry.read_text()
    geometry.write_text(words.replace('input: line_integral', 'input: intensity\nI0: 2'))
    refused('are line integrals', lambda: read_scan(path))
    geometry.write_text(words.replace('nDetector: [6, 8]', 'nDetector: [6, 9]'))
    refused(r'have the shape \(10, 6, 8\)', lambda: read_scan(path))
    geometry.unlink()
    refused('needs its scan geometry', lambda: read_scan(path))
    geometry.write_text(words)
    shutil.rmtree(path)
    zarr.create_array(str(path), shape=(10, 8), chunks=(3, 8), dtype='float32')
    refused('real numbers .n, v, u. are needed', lambda: read_scan(path))
    shutil.rmtree(path)
    zarr.create_array(str(path), shape=(8, 6, 8), chunks=(2, 6, 8), shards=(4, 6, 8), dtype='float32')
    refused('shards', lambda: read_scan(path))
    (path / 'zarr.json').write_text('{')
    refused('damaged', lambda: read_scan(path))
    refused('ends in .zarr', lambda: write_scan(path.with_name('scan.a'), scan, 'zarr'))
    refused('exists already', lambda: write_scan(path, scan, 'zarr'))


def changed(path, **fields):
    file = path / 'zarr.json'
    file.write_text(json.dumps(json.loads(file.read_text()) | fields))


@pytest.mark.parametrize(
    'change, words',
    [
        (lambda path: (path / 'zarr.json').unlink(), 'scan.zarr: has no array in scan.zarr'),
        (
            lambda path: changed(path, data_type='float64'),
            'scan.zarr: a chunk of the views 0 to 9 is cut off or damaged',
        ),
        (lambda path: changed(path, data_type='complex64', fill_value=[0, 0]), 'real numbers .n, v, u. are needed'),
        (lambda path: changed(path, shape=[10, 6, 7]), r'have the shape \(10, 6, 7\)'),
        (lambda path: changed(path, shape=[10**12, 6, 8]), 'scan.zarr: lacks a chunk of the views 12 to 15'),
        (lambda path: changed(path, chunk_grid=grid([5, 6, 8])), 'a chunk of the views 0 to 9 is cut off or damaged'),
        (lambda path: changed(path, chunk_grid=grid([4, 0, 8])), 'scan.zarr: '),
        (lambda path: changed(path, chunk_grid=grid([10**9, 6, 8])), 'scan.zarr: .* memory'),
        (lambda path: (path / 'c/1/0/0').write_bytes((path / 'c/1/0/0').read_bytes() * 2), 'is cut off or damaged'),
    ],
)
def test_metadata_that_do_not_fit(path, change, words):
    change(path)
    refused(words, lambda: read_scan(path).train.projections)


def grid(chunk_shape):
    return dict(name='regular', configuration=dict(chunk_shape=chunk_shape))
