"""Checkpoints: what was altered is refused in one line, whichever entry it is in, and what is sound is read."""

import json
import os
import zipfile
import zlib

import numpy as np
import pytest

from helpers.checkpoints import contents, rewrite
from helpers.fits import SHORT, geometry, tiny_scan
from helpers.short import short
from lingo_mi.common.errors import InputError
from lingo_mi.fitting import checkpoint_schema
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run

METHOD = SHORT.changed(iterations=3, average=0.5, rate_pose=(1e-3, 1e-3), densify_from=100)
ARRAYS = (
    *(f'{group}.{k}' for group in ('values', 'first', 'second') for k in ('centre', 'scale', 'rotation', 'density')),
    *(f'array.average.{k}' for k in ('centre', 'scale', 'rotation', 'density')),
    *(f'array.poses.{k}' for k in ('turn', 'shift', 'first', 'second', 'steps')),
    *('gradient', 'visits', 'born', 'array.initial', 'array.order', 'array.losses'),
)
IN_SHORT_FORM = (  # each group, each parameter and each other array
    *(
        'values.centre',
        'first.scale',
        'second.density',
        'array.average.rotation',
        'array.poses.turn',
        'array.poses.steps',
    ),
    *('gradient', 'visits', 'born', 'array.initial', 'array.order', 'array.losses'),
)
WAYS = {
    'missing': None,
    'empty': lambda a: a[:0],
    'shorter': lambda a: a[:-1],
    'another axis': lambda a: a[..., None],
    'one number': lambda a: np.zeros((), a.dtype),
    'text': lambda a: np.full(a.shape, 'x'),
    'complex': lambda a: a.astype(complex),
    'another type': lambda a: a.astype(np.float16 if a.dtype == np.float32 else np.float32),
    'another order of bytes': lambda a: a.astype('>f4'),
    'NaN': lambda a: np.full(a.shape, np.nan, a.dtype),
    'infinity': lambda a: np.full(a.shape, -np.inf, a.dtype),
    'huge': lambda a: np.full(a.shape, np.iinfo(a.dtype).max),
    'changed': lambda a: a + a.dtype.type(1),
}
PLAIN = (
    'method',
    'settings',
    'scanner',
    'scan',
    'unit',
    'seed',
    'rng',
    'iteration',
    'seconds',
    'history',
    'info',
    'effects',
    'search',
    'seen',
)
VALUES = None, 'text', '', -1, 0, 1.5, float('nan'), float('inf'), 10**400, True, [], [1], {}, {'a': 1}, [{}]
LEGAL = {  # a fit could have left these
    'seed': [0],
    'seconds': [0, 1.5],
    'history': [[]],
    'info': [{}, {'a': 1}],
    'unit': [1.5],
    'effects': [True],
}


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """The path of a checkpoint with averages and poses, and its entries."""
    scan, path = tiny_scan(geometry()), tmp_path_factory.mktemp('whole') / 'fit.npz'
    run(scan, METHOD, seed=3, path=path)
    return path, contents(path)


@pytest.fixture
def refused(tmp_path):
    """A function that writes altered entries and returns the line by which they are refused."""

    def refused(content=None, raw=None):
        path = tmp_path / 'altered.npz'
        if raw is None:
            np.savez(path, **content)
        else:
            path.write_bytes(raw)
        return line(path)

    return refused


def line(path):
    with pytest.raises(InputError) as caught:
        Checkpoint.load(path)
    message = str(caught.value)
    assert message.startswith(f'{path}: ') and '\n' not in message and len(message) < 300 + len(str(path))
    return message.removeprefix(f'{path}: ')


def altered(content, name, way):
    """The entries with one of them altered; None if that is impossible."""
    rest = {k: v for k, v in content.items() if k != name}
    if way == 'missing':
        return rest
    old = content[name]
    if way in ('NaN', 'infinity') and old.dtype.kind != 'f' or way == 'huge' and old.dtype.kind != 'i':
        return None
    new = WAYS[way](old)
    return (
        None if new.shape == old.shape and new.dtype == old.dtype and np.array_equal(new, old) else rest | {name: new}
    )


def test_the_test_knows_every_entry(whole):
    _, content = whole
    assert content.keys() == {*ARRAYS, 'extra', 'checksum'}
    assert json.loads(str(content['extra'])).keys() == {*PLAIN, 'version'}


@pytest.mark.parametrize('name', short({name: name for name in ARRAYS}, IN_SHORT_FORM))
def test_altered_arrays(whole, refused, tmp_path, name):
    """They are refused with the old checksum, and with a right one if the alteration shows."""
    path, content = whole
    for way in WAYS:
        bad = altered(content, name, way)
        if bad is None:
            continue
        assert refused(bad)
        sound = name in ('array.order', 'array.losses') and way in ('empty', 'shorter')
        sound |= name == 'array.initial' and way == 'shorter'
        sound |= way == 'changed' and name not in ('array.order', 'array.poses.steps')
        rewrite(tmp_path / 'rewritten.npz', bad)
        if sound:
            Checkpoint.load(tmp_path / 'rewritten.npz')
        else:
            assert 'checksum' not in line(tmp_path / 'rewritten.npz'), way


@pytest.mark.parametrize('name', PLAIN)
def test_altered_plain_values(whole, refused, tmp_path, name):
    _, content = whole
    extra = json.loads(str(content['extra']))
    path = tmp_path / 'rewritten.npz'
    for value in VALUES:
        bad = extra | {name: value}
        if bad == extra:
            continue
        assert refused(content | {'extra': np.array(json.dumps(bad))})
        rewrite(path, content, bad)
        if any(value == legal and type(value) is type(legal) for legal in LEGAL.get(name, ())):
            Checkpoint.load(path)
        else:
            assert line(path), value
    rewrite(path, content, {k: v for k, v in extra.items() if k != name})
    assert f'{name} is missing' in line(path)


def test_a_history_of_one_gaussian(whole, tmp_path):
    _, content = whole
    extra = json.loads(str(content['extra']))
    for count in (1, 0):
        extra['history'][0]['gaussians'] = count
        rewrite(tmp_path / 'rewritten.npz', content, extra)
        if count:
            Checkpoint.load(tmp_path / 'rewritten.npz')
        else:
            assert 'history has no Gaussians' in line(tmp_path / 'rewritten.npz')


def test_the_least_state_of_a_generator(whole, tmp_path):
    _, content = whole
    extra = json.loads(str(content['extra']))
    extra['rng'] |= {'state': {'state': 0, 'inc': 0}, 'has_uint32': 0, 'uinteger': 0}
    rewrite(tmp_path / 'rewritten.npz', content, extra)
    assert Checkpoint.load(tmp_path / 'rewritten.npz')


@pytest.mark.parametrize(
    'name, key, values',
    [
        ('rng', 'state', [None, 3, {}, {'state': 1}, {'state': -1, 'inc': 1}, {'state': 2**128, 'inc': 1}]),
        ('rng', 'bit_generator', [None, 'MT19937', 3]),
        ('rng', 'has_uint32', [None, 2, 0.5]),
        ('rng', 'uinteger', [None, 2**32, -1]),
        ('rng', 'more', [1]),
        ('info', 'seconds', [None, 'long', -1, float('nan')]),
        ('settings', 'renamed', [1]),
        ('settings', 'self', [1]),
        ('settings', 'lambda_tv', [None, 'x', float('nan'), -1, 10**400, [1, 2]]),
        ('settings', 'iterations', [None, 2, 0, 1.5, 10**400]),
        ('settings', 'rate_pose', [[0, 0], [1], 'x']),
        ('settings', 'start', ['random', 'x', 3]),
        ('settings', 'densify', ['halve', 'opacities', None]),
        ('scan', 'views', [None, 0, 4, 3.0, True]),
        ('scan', 'signal', [None, 'x', float('nan'), 10**400]),
        ('scan', 'moments', [None, 3, [], [1, 2], ['x', 0, 0], [0, 0, float('inf')]]),
        ('scan', 'valid', ['x', 3, True]),
        ('scan', 'effects', ['x', 3, True]),
        ('scan', 'more', [1]),
        ('scanner', 'type', [None, 'bitmap']),
        ('scanner', 'filename', ['/etc/passwd']),
        ('scanner', 'poses', ['/etc/passwd', '1', 'nan', '../1']),
        ('scanner', 'DSO', [None, 'x', -1, float('inf'), 1e308, 10**400, []]),
        ('scanner', 'nDetector', ['0, 0', 'x', '1e308', '1,2,3']),
        ('scanner', 'angles', ['', 'x', '1, 2', 'nan, nan, nan']),
    ],
)
def test_altered_parts_of_plain_values(whole, tmp_path, name, key, values):
    _, content = whole
    for value in values:
        extra = json.loads(str(content['extra']))
        extra[name][key] = value
        rewrite(tmp_path / 'rewritten.npz', content, extra)
        assert line(tmp_path / 'rewritten.npz'), value


@pytest.mark.parametrize(
    'entry, value',
    [
        ('iteration', 0),
        ('iteration', 10**6),
        ('iteration', 'x'),
        ('iteration', None),
        ('seconds', -1),
        ('seconds', float('nan')),
        ('loss', None),
        ('loss', float('inf')),
        ('gaussians', 0),
        ('gaussians', 1.5),
        ('psnr_2d', 'good'),
        ('psnr_2d', 10**400),
    ],
)
def test_altered_history(whole, tmp_path, entry, value):
    _, content = whole
    extra = json.loads(str(content['extra']))
    extra['history'][0][entry] = value
    rewrite(tmp_path / 'rewritten.npz', content, extra)
    assert 'history' in line(tmp_path / 'rewritten.npz')


def test_what_does_not_belong_there(whole, refused, tmp_path):
    _, content = whole
    for more in ('values.hue', 'array.share', 'strange', 'array.poses.more'):
        assert 'checksum' in refused({**content, more: np.zeros(3)})
        rewrite(tmp_path / 'rewritten.npz', {**content, more: np.zeros(3)})
        assert more in line(tmp_path / 'rewritten.npz')
    rewrite(tmp_path / 'rewritten.npz', content, json.loads(str(content['extra'])) | {'more': 1})
    assert 'more' in line(tmp_path / 'rewritten.npz')


def test_extra_that_is_no_json(whole, refused, tmp_path):
    _, content = whole
    texts = '', 'x', '[' * 100_000, '{}', '[]', '3', 'null', '{"iteration": ' + '9' * 5000 + '}'
    for extra in (*(np.array(text) for text in texts), np.zeros(3), np.array(b'{}')):
        assert refused({**content, 'extra': extra})
        np.savez(
            tmp_path / 'rewritten.npz', **{**{k: v for k, v in content.items() if k != 'checksum'}, 'extra': extra}
        )
        assert line(tmp_path / 'rewritten.npz')


def test_checksums(whole, refused):
    _, content = whole
    assert 'checksum is missing' in refused({k: v for k, v in content.items() if k != 'checksum'})
    for wrong in ('', 'f' * 32, str(content['checksum'])[::-1], 3, np.zeros(5)):
        assert 'checksum' in refused({**content, 'checksum': np.array(wrong)})


@pytest.mark.parametrize('name', PLAIN)
def test_plain_values_are_checked_without_the_file(whole, name):
    _, content = whole
    extra = json.loads(str(content['extra']))
    short = {k: v for k, v in extra.items() if k != name}
    arrays = {k: v for k, v in content.items() if k not in ('extra', 'checksum')}
    with pytest.raises(InputError, match=f'{name} is missing'):
        checkpoint_schema.require_sound(arrays, short)


def test_sizes_are_checked_before_memory_is_taken(whole, refused, tmp_path):
    path, content = whole
    np.savez_compressed(tmp_path / 'bomb.npz', **{**content, 'strange': np.zeros(10**7)})
    assert 'compressed' in line(tmp_path / 'bomb.npz')
    for claim in (b'(99999999999999, 3)', b'(-60, 3)', b'(0,)', b'(2, 2)', b'(60, 3 ', b'[]', b'print'):
        raw = path.read_bytes()
        with zipfile.ZipFile(path) as archive:
            entry = archive.getinfo('values.centre.npy')
            old = archive.read(entry)
        begin = old.index(b'(60, 3)')
        header = old[: old.index(b'\n') + 1]
        new = (header.replace(b'(60, 3)', claim).rstrip(b'\n ')).ljust(len(header) - 1)[: len(header) - 1] + b'\n'
        assert begin and len(new) == len(header)
        changed = new + old[len(header) :]
        at = raw.index(old)
        raw = raw[:at] + changed + raw[at + len(old) :]
        raw = raw.replace(zlib.crc32(old).to_bytes(4, 'little'), zlib.crc32(changed).to_bytes(4, 'little'))
        assert 'an entry' in refused(raw=raw)


def test_bytes_that_were_altered(whole, refused):
    """A checkpoint is refused whatever byte of its content is flipped, and wherever it is cut."""
    raw = whole[0].read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(0, len(raw), 40):
        assert refused(raw=raw[:at])
    with zipfile.ZipFile(whole[0]) as archive:
        for entry in archive.infolist():
            begin = raw.index(archive.read(entry))
            for at in begin + rng.integers(0, entry.file_size, 4):
                assert refused(raw=raw[:at] + bytes([raw[at] ^ 1 << rng.integers(8)]) + raw[at + 1 :])


def test_entries_twice(whole, tmp_path):
    path = tmp_path / 'twice.npz'
    path.write_bytes(whole[0].read_bytes())
    with zipfile.ZipFile(path, 'a') as archive, pytest.warns(UserWarning, match='Duplicate'):
        archive.writestr('visits.npy', archive.read('visits.npy'))
    assert 'twice' in line(path)


@pytest.mark.posix
def test_files_that_are_no_files(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    for path in (tmp_path, tmp_path / 'pipe', '/dev/zero'):
        assert 'not a regular file' in line(path)


@pytest.mark.parametrize('version', [None, 1, 3, 2.5, '2', True])
def test_other_versions_are_refused(whole, tmp_path, version):
    """They belong to earlier programs, at first without version and checksum, and to later programs."""
    _, content = whole
    extra, path = json.loads(str(content['extra'])), tmp_path / 'checkpoint.npz'
    before = {k: v for k, v in extra.items() if k != 'version'}
    rewrite(path, content, before | {'version': version} if version else before)
    assert f'its version is {version!r}, but this program reads 2; start again' in line(path)
    for read in (Fit.load, lambda path: run(tiny_scan(geometry()), METHOD, seed=3, path=path, resume=True)):
        with pytest.raises(InputError, match=r'but this program reads 2; start again$') as caught:
            read(path)
        assert '\n' not in str(caught.value)
    np.savez(path, **{k: v for k, v in content.items() if k != 'checksum'})
    assert 'its checksum is missing; start again' in line(path)
