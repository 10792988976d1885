"""The R2-Gaussian folder."""

import json
import re

import numpy as np
import pytest

from helpers.scans import small_dataset
from lingo_mi.common.errors import InputError
from lingo_mi.files import r2
from lingo_mi.scan import Dataset, Scan


def folder(tmp_path, vol_key='vol', **changes):
    """A folder as R2-Gaussian's own synthetic scanner writes it, with asymmetric sizes."""
    rng = np.random.default_rng(0)
    meta = {
        'scanner': {
            'mode': 'cone',
            'filter': None,
            'DSD': 7,
            'DSO': 5,
            'nDetector': [4, 6],
            'sDetector': [4, 3],
            'nVoxel': [5, 6, 8],
            'sVoxel': [1, 1.5, 2],
            'offOrigin': [0.1, 0.2, 0.3],
            'offDetector': [0.4, 0.5],
            'accuracy': 0.5,
            'totalAngle': 360,
            'startAngle': 0,
            'noise': True,
            'possion_noise': 10000,
        },
        vol_key: 'vol_gt.npy',
        'bbox': [[-1, -1, -1], [1, 1, 1]],
    }
    images = {}
    for split, n in (('proj_train', 3), ('proj_test', 2)):
        (tmp_path / split).mkdir()
        meta[split] = []
        images[split] = rng.random((n, 4, 6)).astype(np.float32)
        for i in range(n):
            name = f'{split}/{split}_{i:04d}.npy'
            np.save(tmp_path / name, images[split][i])
            meta[split].append({'file_path': name, 'angle': 0.1 + i})
    images['vol'] = rng.random((5, 6, 8)).astype(np.float32)
    np.save(tmp_path / 'vol_gt.npy', images['vol'])
    for key, value in changes.items():
        at = meta['scanner'] if key in meta['scanner'] or key.startswith('d') else meta
        at[key] = value
        if value is ...:
            del at[key]
    (tmp_path / 'meta_data.json').write_text(json.dumps(meta))
    return images


def refused(path, match, where='meta_data.json'):
    with pytest.raises(InputError, match=match) as caught:
        r2.read_r2(path)
    assert '\n' not in str(caught.value) and where in str(caught.value)


@pytest.mark.parametrize('vol_key', ['vol', 'ct'])
def test_reads_its_own_layout(tmp_path, vol_key):
    images = folder(tmp_path, vol_key)
    dataset = r2.read_r2(tmp_path)
    g = dataset.train.geometry
    assert (g.DSO, g.DSD, g.nDetector, g.dDetector) == (5, 7, (4, 6), (1, 0.5))
    assert (g.grid.shape, g.grid.spacing, g.grid.centre) == ((5, 6, 8), (0.2, 0.25, 0.25), (0.1, 0.2, 0.3))
    assert g.offDetector == (0.5, 0.4)  # the file has (u, v)
    np.testing.assert_array_equal(g.angles, [0.1, 1.1, 2.1])
    np.testing.assert_array_equal(dataset.train.projections, images['proj_train'])
    np.testing.assert_array_equal(dataset.test.projections, images['proj_test'])
    np.testing.assert_array_equal(dataset.volume, images['vol'])


def test_optional_parts(tmp_path):
    folder(tmp_path, vol=..., proj_test=[], offOrigin=..., offDetector=..., mode=...)
    dataset = r2.read_r2(tmp_path)
    assert dataset.test is None and dataset.volume is None and dataset.train.geometry.mode == 'cone'


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
def test_round_trip(tmp_path, mode):
    from dataclasses import replace

    a = small_dataset()
    a = Dataset(*(Scan(replace(s.geometry, mode=mode), s.projections) for s in (a.train, a.test)), a.volume)
    r2.write_r2(tmp_path / 'scan', a)
    b = r2.read_r2(tmp_path / 'scan')
    for x, y in ((a.train, b.train), (a.test, b.test)):
        assert vars(x.geometry) | {'angles': 0} == vars(y.geometry) | {'angles': 0}
        np.testing.assert_array_equal(x.geometry.angles, y.geometry.angles)
        np.testing.assert_array_equal(x.projections, y.projections)
    np.testing.assert_array_equal(a.volume, b.volume)
    assert [p.name for p in tmp_path.iterdir()] == ['scan']


def test_writes_what_its_reader_looks_up(tmp_path):
    r2.write_r2(tmp_path / 'scan', small_dataset())
    meta = json.loads((tmp_path / 'scan' / 'meta_data.json').read_text())
    assert {
        'DSD',
        'DSO',
        'nDetector',
        'sDetector',
        'dDetector',
        'nVoxel',
        'sVoxel',
        'dVoxel',
        'offOrigin',
        'offDetector',
        'mode',
        'filter',
        'accuracy',
        'totalAngle',
        'startAngle',
    } <= meta['scanner'].keys()
    assert meta['scanner']['offDetector'] == [-5, 4] and meta['scanner']['noise'] is False
    assert meta['bbox'] == [[-1.5, -8, -7.5], [3.5, 4, 13.5]]


BAD = {
    'scanner': ({'scanner': ...}, "no 'scanner'"),
    'DSO': ({'DSO': ...}, 'DSO is missing'),
    'panel': ({'nDetector': [6, 4]}, 'expected|shape'),
    'sizes': ({'sDetector': ...}, 'neither dDetector nor sDetector'),
    'both sizes': ({'dVoxel': [9, 9, 9]}, 'disagree'),
    'no views': ({'proj_train': []}, 'no views'),
    'no train': ({'proj_train': ...}, 'no views'),
    'views no list': ({'proj_train': {'a': 1}}, 'must be a list'),
    'no angle': ({'proj_train': [{'file_path': 'proj_train/proj_train_0000.npy'}]}, 'entry 0'),
    'angle text': ({'proj_train': [{'file_path': 'proj_train/proj_train_0000.npy', 'angle': 'x'}]}, 'entry 0'),
    'angle NaN': ({'proj_train': [{'file_path': 'proj_train/proj_train_0000.npy', 'angle': float('nan')}]}, 'finite'),
    'volume shape': ({'nVoxel': [8, 6, 5]}, 'volume has the shape'),
}


@pytest.mark.parametrize('name', BAD)
def test_contradictions(tmp_path, name):
    changes, match = BAD[name]
    meta_only = {'scanner', 'proj_train'} & changes.keys()
    folder(tmp_path, **({} if meta_only else changes))
    if meta_only:
        path = tmp_path / 'meta_data.json'
        meta = json.loads(path.read_text())
        for key, value in changes.items():
            meta[key] = value
            if value is ...:
                del meta[key]
        path.write_text(json.dumps(meta))
    refused(tmp_path, match)


def test_missing_and_damaged_files(tmp_path):
    refused(tmp_path, 'no such file')
    folder(tmp_path)
    path = tmp_path / 'proj_test' / 'proj_test_0001.npy'
    raw = path.read_bytes()
    path.write_bytes(raw[:-3])
    refused(tmp_path, 'damaged|read', 'proj_test_0001.npy')
    path.write_bytes(b'')
    refused(tmp_path, 'damaged', 'proj_test_0001.npy')
    np.save(path, np.full((4, 6), np.nan))
    refused(tmp_path, 'NaN', 'proj_test_0001.npy')
    np.save(path, np.ones((6, 4)))
    refused(tmp_path, 'one panel', 'proj_test_0001.npy')
    np.save(path, np.array([[{}]]), allow_pickle=True)
    refused(tmp_path, 'damaged', 'proj_test_0001.npy')
    path.unlink()
    refused(tmp_path, 'no such file', 'proj_test_0001.npy')
    path.write_bytes(raw)
    (tmp_path / 'vol_gt.npy').unlink()
    refused(tmp_path, 'no such file', 'vol_gt.npy')
    (tmp_path / 'meta_data.json').write_text('{"scanner": ')
    refused(tmp_path, 'not valid JSON')


def test_write_refuses_a_folder_in_use(tmp_path):
    r2.write_r2(tmp_path / 'scan', small_dataset())
    with pytest.raises(InputError, match='exists already'):
        r2.write_r2(tmp_path / 'scan', small_dataset())
    (tmp_path / 'file').touch()
    for path in (tmp_path / 'file', tmp_path / 'file' / 'scan', tmp_path / 'none' / 'scan'):
        with pytest.raises(InputError, match='exists already|cannot be written'):
            r2.write_r2(path, small_dataset())
    assert sorted(p.name for p in tmp_path.iterdir()) == ['file', 'scan']


def test_numbers_nested_too_deep(tmp_path):
    folder = tmp_path / 'a'
    r2.write_r2(folder, small_dataset())
    meta = folder / 'meta_data.json'
    content = meta.read_text()
    for deep in (600, 100_000):
        meta.write_text(re.sub(r'"DSO": [\d.]+', f'"DSO": {"[" * deep}1{"]" * deep}', content))
        with pytest.raises(InputError, match='DSO must be numbers|not valid JSON') as caught:
            r2.read_r2(folder)
        assert len(str(caught.value)) < 300


@pytest.mark.parametrize('name', ['/etc/hostname', '../v.npy', 3, None, ''])
def test_files_elsewhere(tmp_path, name):
    folder = tmp_path / 'a'
    r2.write_r2(folder, small_dataset())
    meta = folder / 'meta_data.json'
    content = json.loads(meta.read_text())
    content['proj_train'][0]['file_path'] = name
    meta.write_text(json.dumps(content))
    with pytest.raises(InputError, match='beside it'):
        r2.read_r2(folder)


def test_one_image_listed_many_times(tmp_path, monkeypatch):
    folder(tmp_path)
    meta = json.loads((tmp_path / 'meta_data.json').read_text())
    meta['proj_train'] = meta['proj_train'][:1] * 50
    (tmp_path / 'meta_data.json').write_text(json.dumps(meta))
    monkeypatch.setattr('lingo_mi.common.memory.host_room', lambda: 49 * 24 * 8)
    refused(tmp_path, 'memory')
    meta['proj_train'] *= 3000
    (tmp_path / 'meta_data.json').write_text(json.dumps(meta))
    refused(tmp_path, 'lists 150000 views, but a scan has at most 100000')
