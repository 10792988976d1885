"""The NAF pickle: conventions, round trip, and what a hostile pickle may do (nothing)."""

import os
import pickle
import pickletools

import numpy as np
import pytest

from helpers.scans import small_dataset
from lingo_mi.common.errors import InputError
from lingo_mi.files import naf
from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.scan import Dataset, Scan


def plain(**changes):
    """A pickle's dictionary: 3 views of 4 rows and 5 columns, a volume of (6, 7, 8) voxels."""
    rng = np.random.default_rng(0)
    data = {
        'numTrain': 3,
        'numVal': 2,
        'DSD': 1500.0,
        'DSO': 1000.0,
        'nDetector': [4, 5],
        'dDetector': [2.0, 3.0],
        'nVoxel': [6, 7, 8],
        'dVoxel': [1.0, 1.5, 2.0],
        'offOrigin': [1, 2, 3],
        'offDetector': [10, 20],
        'accuracy': 0.5,
        'mode': 'cone',
        'filter': None,
        'totalAngle': 180.0,
        'startAngle': 0.0,
        'randomAngle': False,
        'image': rng.random((6, 7, 8)).astype(np.float32),
        'train': {'projections': rng.random((3, 4, 5)).astype(np.float32), 'angles': np.array([0.1, 1.0, 2.0])},
        'val': {'projections': rng.random((2, 4, 5)), 'angles': np.array([0.5, 1.5])},
    }
    data.update(changes)
    return {key: value for key, value in data.items() if value is not ...}


def dumped(tmp_path, obj, protocol=4):
    path = tmp_path / 'scan.pickle'
    path.write_bytes(obj if isinstance(obj, bytes) else pickle.dumps(obj, protocol))
    return path


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        naf.read_naf(path)
    assert '\n' not in str(caught.value) and str(path) in str(caught.value)


# ---- conventions -------------------------------------------------------------------------------------------


@pytest.mark.parametrize('protocol', range(6))
@pytest.mark.parametrize('core', [b'numpy.core.', b'numpy._core.'])
def test_reads_every_protocol_and_both_numpy_names(tmp_path, protocol, core):
    data = plain()
    raw = pickle.dumps(data, protocol)
    if core not in raw:  # the other name, with the length of a length-prefixed string corrected
        other = b'numpy._core.' if core == b'numpy.core.' else b'numpy.core.'
        raw = renamed(raw, other, core)
    if protocol < 5:
        assert core in raw
    dataset = naf.read_naf(dumped(tmp_path, raw))
    np.testing.assert_allclose(dataset.train.projections, data['train']['projections'] * 1000, rtol=1e-6)
    np.testing.assert_array_equal(dataset.volume, data['image'])


def renamed(raw, old, new):
    out, at = bytearray(), 0
    ops = list(pickletools.genops(raw))
    for (op, arg, start), end in zip(ops, [o[2] for o in ops[1:]] + [len(raw)]):
        piece = raw[start:end]
        if op.name == 'FRAME':
            continue
        if isinstance(arg, str) and old.decode() in arg:
            arg = arg.replace(old.decode(), new.decode())
            piece = (
                b'c' + arg.replace(' ', '\n').encode() + b'\n'
                if op.name == 'GLOBAL'
                else b'\x8c' + bytes([len(arg)]) + arg.encode()
            )
        out += piece
        at = end
    assert at == len(raw)
    return bytes(out)


def test_units_and_orders(tmp_path):
    g = naf.read_naf(dumped(tmp_path, plain())).train.geometry
    assert (g.DSO, g.DSD) == (1000, 1500)
    assert g.nDetector == (4, 5) and g.dDetector == (2, 3)
    assert g.grid.shape == (6, 7, 8) and g.grid.spacing == (1, 1.5, 2)
    assert g.grid.centre == (1, 2, 3)
    assert g.offDetector == (20, 10)  # the file has (u, v), TIGRE gets (v, u)
    np.testing.assert_array_equal(g.angles, [0.1, 1.0, 2.0])


def test_panel_given_as_u_v_is_told_by_the_projections(tmp_path):
    g = naf.read_naf(dumped(tmp_path, plain(nDetector=[5, 4], dDetector=[3.0, 2.0]))).train.geometry
    assert g.nDetector == (4, 5) and g.dDetector == (2, 3)


def test_line_integrals_of_a_known_object(tmp_path):
    """A block of density 1 and 6 mm length along x: TIGRE, in metres, gives 0.006, which is 6 here; a spot
    above the axis lies in the upper rows."""
    image = np.zeros((1, 4, 5), np.float32)
    image[0, 0, 3] = 0.006
    dataset = naf.read_naf(
        dumped(
            tmp_path,
            plain(numTrain=1, val=..., train={'projections': image, 'angles': np.zeros(1)}, offDetector=[0, 0]),
        )
    )
    assert dataset.train.projections.max() == pytest.approx(6)
    x, y = dataset.train.geometry.rays().project(np.array([[0.0, 2.0, 1.5]]), 0)
    assert y[0] < 2 and x[0] > 2.5
    assert dataset.train.projections[0, int(y[0]), int(x[0])] == pytest.approx(6)


def test_optional_keys(tmp_path):
    few = plain(
        image=...,
        val=...,
        mode=...,
        offOrigin=...,
        offDetector=...,
        numTrain=...,
        numVal=...,
        accuracy=...,
        dVoxel=...,
        sVoxel=[6, 10.5, 16],
    )
    dataset = naf.read_naf(dumped(tmp_path, few))
    g = dataset.train.geometry
    assert dataset.test is None and dataset.volume is None
    assert g.mode == 'cone' and g.grid.centre == (0, 0, 0) and g.offDetector == (0, 0) and g.grid.spacing == (1, 1.5, 2)


def test_parallel_beam_needs_no_distances(tmp_path):
    g = naf.read_naf(dumped(tmp_path, plain(mode='parallel', DSO=..., DSD=...))).train.geometry
    assert g.mode == 'parallel'


def test_held_out_views_may_be_called_test(tmp_path):
    data = plain()
    data['test'] = data.pop('val')
    assert len(naf.read_naf(dumped(tmp_path, data)).test) == 2


def assert_same(a, b):
    for x, y in ((a.train, b.train), (a.test, b.test)):
        assert vars(x.geometry) | {'angles': 0} == vars(y.geometry) | {'angles': 0}
        np.testing.assert_allclose(x.geometry.angles, y.geometry.angles, rtol=0, atol=1e-15)
        np.testing.assert_allclose(x.projections, y.projections, rtol=3e-7)
    np.testing.assert_array_equal(a.volume, b.volume)


def test_round_trip(tmp_path):
    naf.write_naf(tmp_path / 'a.pickle', small_dataset())
    assert_same(naf.read_naf(tmp_path / 'a.pickle'), small_dataset())
    assert os.listdir(tmp_path) == ['a.pickle']


def test_the_written_file_is_an_ordinary_pickle_for_numpy_1_and_2(tmp_path):
    path = tmp_path / 'a.pickle'
    naf.write_naf(path, small_dataset())
    raw = path.read_bytes()
    assert b'_core' not in raw and b'numpy.core' not in raw
    data = pickle.loads(raw)
    np.testing.assert_allclose(data['train']['projections'] * 1000, small_dataset().train.projections, rtol=3e-7)
    assert data['train']['projections'].flags.writeable
    assert data['nDetector'] == [4, 6] and data['offDetector'] == [-5, 4]


def test_fortran_and_big_endian_arrays_and_scalars(tmp_path):
    data = plain(DSO=np.float32(1000), DSD=np.float64(1500), numTrain=np.int64(3))
    p = data['train']['projections']
    data['train']['projections'] = np.asfortranarray(p).astype('>f8')
    dataset = naf.read_naf(dumped(tmp_path, data))
    np.testing.assert_allclose(dataset.train.projections, p * 1000, rtol=1e-6)


# ---- hostile pickles ---------------------------------------------------------------------------------------


class Call:
    def __init__(self, function, *args):
        self.reduce = function, args

    def __reduce__(self):
        return self.reduce


HOSTILE = {
    'os.system': (os.system, 'touch {}'),
    'eval': (eval, 'open({!r}, "w")'),
    'exec': (exec, 'open({!r}, "w")'),
    'open': (open, '{}', 'w'),
    'getattr': (getattr, 'a', 'upper'),
    'numpy.load': (np.load, '{}'),
    'numpy.fromfile': (np.fromfile, '{}'),
    'numpy.save': (np.save, '{}', 1),
    'numpy.frombuffer': (np.frombuffer, b'1234'),
}


@pytest.mark.parametrize('name', HOSTILE)
@pytest.mark.parametrize('place', ['root', 'key', 'object array'])
def test_calls_are_refused_by_name_and_not_made(tmp_path, name, place):
    touched = tmp_path / 'touched'
    function, *args = HOSTILE[name]
    call = Call(function, *(a.format(str(touched)) if isinstance(a, str) else a for a in args))
    if place == 'key':
        call = plain(extra=call)
    elif place == 'object array':
        array = np.empty(2, object)
        array[:] = [call, 1]
        call = plain(image=array)
    # an object array is refused at its type, before its content
    refused(dumped(tmp_path, call), 'the global|the array type' if place == 'object array' else name.split('.')[-1])
    assert not touched.exists()


@pytest.mark.parametrize(
    'module, name',
    [
        ('posix', 'system'),
        ('builtins', 'eval'),
        ('builtins', '__import__'),
        ('numpy.testing._private.utils', 'runstring'),
        ('numpy.f2py', 'compile'),
        ('numpy.f2py.crackfortran', 'myeval'),
        ('numpy', 'dtype.__init__'),
        ('numpy.core.multiarray', 'fromfile'),
        ('numpy._core._multiarray_umath', '_reconstruct'),
        ('functools', 'partial'),
        ('_codecs', 'lookup'),
        ('torch._utils', '_rebuild_tensor_v2'),
        ('copyreg', '_reconstructor'),
    ],
)
def test_other_globals_are_refused(tmp_path, module, name):
    short = [b'\x8c' + bytes([len(s)]) + s.encode() for s in (module, name)]
    refused(dumped(tmp_path, b'\x80\x04' + short[0] + short[1] + b'\x93)R.'), f'the global {module}.{name}')
    refused(dumped(tmp_path, f'c{module}\n{name}\n.'.encode()), f'the global {module}.{name}')


@pytest.mark.parametrize('name', ['object', 'V8', 'S4', 'U4', 'M8[s]', 'no such type', [('a', 'f4')]])
def test_types_that_are_not_numbers_are_refused(tmp_path, name):
    refused(dumped(tmp_path, plain(image=Call(np.dtype, name))), 'the array type')


def test_a_type_that_hides_objects_is_refused(tmp_path):
    """dtype('O') with its flags cleared would let raw bytes pass for object pointers."""
    array = np.arange(3.0)
    raw = pickle.dumps(array, 2).replace(b'f8', b'O8')
    refused(dumped(tmp_path, raw), 'the array type')


def test_array_size_must_match_its_data(tmp_path):
    raw = pickle.dumps({'train': np.arange(3.0)}, 2)
    assert b'K\x03\x85' in raw
    refused(dumped(tmp_path, raw.replace(b'K\x03\x85', b'K\x7f\x85')), 'size does not match')


def test_stand_ins_cannot_be_changed_or_returned(tmp_path):
    stand_in = b'cnumpy\nndarray\n'
    refused(dumped(tmp_path, stand_in + b'.'), 'a value of type')
    for state in (b"(dS'__call__'\nNsb.", b"(N(dS'__call__'\nNstb.", b"(N(dS'__class__'\nNstb."):
        refused(dumped(tmp_path, stand_in + state), str(tmp_path))
    refused(dumped(tmp_path, stand_in + b')R.'), str(tmp_path))
    refused(dumped(tmp_path, b'c_codecs\nencode\n(Va\nVrot13\ntR.'), 'text encoding')
    refused(dumped(tmp_path, b'Vname\nQ.'), 'persistent')


def test_the_message_stays_on_one_line_whatever_the_name(tmp_path):
    refused(dumped(tmp_path, b'\x80\x04\x8c\x03a\nb\x8c\x01c\x93.'), 'the global a b.c')


def test_self_containing_data_ends(tmp_path):
    loop = plain()
    loop['loop'] = loop
    refused(dumped(tmp_path, loop), 'nested')


# ---- bad input ---------------------------------------------------------------------------------------------


def test_missing_and_unreadable(tmp_path):
    refused(tmp_path / 'none.pickle', 'no such file')
    refused(tmp_path, 'cannot be read')


@pytest.mark.parametrize('keep', [0, 1, 50, 0.5, -1])
@pytest.mark.parametrize('protocol', [2, 5])
def test_truncated(tmp_path, keep, protocol):
    raw = pickle.dumps(plain(), protocol)
    refused(dumped(tmp_path, raw[: int(keep * len(raw)) if isinstance(keep, float) else keep]), 'truncated, damaged')


def test_not_a_pickle(tmp_path):
    refused(dumped(tmp_path, b'hello world'), 'not a pickle')


NAN = np.full((3, 4, 5), np.nan, np.float32)
BAD = {
    'a list': ([1, 2], 'not a NAF scan'),
    'no train': (plain(train=...), 'not a NAF scan'),
    'train is not a dictionary': (plain(train=3), "'train' must be"),
    'no angles': (plain(train={'projections': NAN}), "'train' must be"),
    'no DSO': (plain(DSO=...), 'DSO is missing'),
    'DSD < DSO': (plain(DSD=500.0), 'DSD >= DSO'),
    'DSO text': (plain(DSO='far'), 'DSO must be numbers'),
    'DSO yes': (plain(DSO=True), 'DSO must be numbers'),
    'no nDetector': (plain(nDetector=...), 'nDetector is missing'),
    'no dVoxel': (plain(dVoxel=...), 'neither dVoxel nor sVoxel'),
    'd and s disagree': (plain(sVoxel=[1, 1, 1]), 'disagree'),
    'wrong panel': (plain(nDetector=[4, 6]), 'does not match the projections'),
    'half pixels': (plain(nDetector=[4.5, 5]), 'whole numbers'),
    'two voxel counts': (plain(nVoxel=[6, 7]), 'nVoxel must be 3'),
    'zero voxel size': (plain(dVoxel=[1, 0, 1]), 'dVoxel must be positive'),
    'mode': (plain(mode='helical'), 'mode must be'),
    'volume shape': (plain(image=np.ones((8, 7, 6), np.float32)), 'nVoxel is'),
    'volume NaN': (plain(image=np.full((6, 7, 8), np.nan)), 'NaN'),
    'projections NaN': (plain(train={'projections': NAN, 'angles': np.arange(3.0)}), 'NaN'),
    'projections 2D': (plain(train={'projections': NAN[0], 'angles': np.arange(3.0)}), '3 dimensions'),
    'projections ragged': (plain(train={'projections': [[1], [1, 2]], 'angles': [1.0, 2.0]}), 'not an array'),
    'projections text': (plain(train={'projections': ['a', 'b', 'c'], 'angles': np.arange(3.0)}), 'not an array'),
    'no views': (plain(train={'projections': np.ones((0, 4, 5)), 'angles': np.ones(0)}, numTrain=0), 'no views'),
    'angles count': (plain(train={'projections': NAN * 0 + 1, 'angles': np.arange(2.0)}), 'agree|NaN'),
    'numTrain': (plain(numTrain=7), 'agree'),
    'numVal': (plain(numVal=7), 'agree'),
    'numTrain array': (plain(numTrain=np.ones(3)), 'must be one number'),
    'mode array': (plain(mode=np.ones(3)), 'mode must be'),
    'mode list': (plain(mode=['cone']), 'mode must be'),
    'DSO huge': (plain(DSO=1e308, DSD=1e308), 'DSO must be finite lengths'),
    'DSD whole': (plain(DSD=10**300), 'at most'),
    'DSD of 400 digits': (plain(DSD=10**400), 'bits'),
    'dDetector huge': (plain(dDetector=[1e308, 1e308]), 'dDetector must be finite lengths'),
    'dVoxel tiny': (plain(dVoxel=1e-300), 'lengths of a scan must lie'),
    'offDetector huge': (plain(offDetector=[1e300, 0]), 'offDetector must be finite lengths'),
    'nDetector huge': (plain(nDetector=[1e300, 1e300]), 'does not match'),
    'a text too long': (plain(DSO='x' * 20_000), 'text of 20000'),
    'a key that is a tuple': (plain(**{}) | {(1, 2): 3}, 'key of type tuple'),
    'a set': (plain(mode={1, 2}), 'a set'),
}


@pytest.mark.parametrize('name', BAD)
def test_contradictions(tmp_path, name):
    data, match = BAD[name]
    refused(dumped(tmp_path, data), match)


def test_write_refuses(tmp_path):
    dataset = small_dataset()
    with pytest.raises(InputError, match='cannot be written'):
        naf.write_naf(tmp_path / 'no folder' / 'a.pickle', dataset)
    other = Scan(
        CircularGeometry(
            DSO=900, DSD=1400, nDetector=(4, 6), dDetector=(1.5, 2.5), angles=[0.0], grid=Grid((5, 6, 7), (1, 2, 4))
        ),
        np.ones((1, 4, 6)),
    )
    with pytest.raises(InputError, match='one scanner'):
        naf.write_naf(tmp_path / 'a.pickle', Dataset(dataset.train, other))
    assert not list(tmp_path.iterdir())


# ---- small files that would become large -------------------------------------------------------------------


def nested(levels, code):
    """A pickle in which each level holds the one below it ten times."""
    return b'\x80\x04K\x01' + b''.join(
        b'\x94' + (b'(' if code == b't' else b'](') + b'h' + bytes([i]) + (b'h' + bytes([i])) * 9 + code
        for i in range(levels)
    )


@pytest.mark.parametrize(
    'raw, match',
    [
        (b'\x80\x04}r\xff\xff\xff\x7f.', 'memo'),
        (b'\x80\x02}p2147483647\n.', 'memo'),
        (nested(20, b't') + b'.', 'values'),
        (nested(20, b'e') + b'.', 'values'),
        (nested(20, b't').replace(b'\x80\x04', b'\x80\x04}', 1) + b'K\x01s.', 'key of type tuple'),
        (b'\x80\x04\x8f.', 'a set'),
        (b'\x80\x04' + b'(' * 10**6 + b'.', 'instructions|damaged'),
        (b'\x80\x04' + b'K\x010' * 10**6 + b'N.', 'instructions'),
        (b'\x80\x04\x8e' + b'\xff' * 7 + b'\x0f' + b'abc.', 'damaged'),
        (b'\x80\x04\x95' + b'\xff' * 7 + b'\x0fN.', 'damaged'),
        (b'', 'damaged'),
    ],
)
def test_bombs(tmp_path, raw, match):
    refused(dumped(tmp_path, raw), match)


def test_every_value_counts():
    """A list and its values count, and again at every further use."""
    held = ['a', 'b']
    for value, count in (([], 1), (held, 3), ([held, held], 7), ({'k': held}, 4)):
        assert naf._resolve(value, [count]) == value
        with pytest.raises(naf._Refused, match='more than'):
            naf._resolve(value, [count - 1])
