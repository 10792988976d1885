"""The pickle of NAF and SAX-NeRF (X3D): one dictionary with the scanner, the projections and the true volume.

Facts of the format, from the generator and the readers that use it:

- Lengths are in mm, but the projections were computed in metres: their values are density times metres.
- `projections` are [n, v, u], rows along -z: TIGRE's rows, which run along +z, are flipped before they are
  stored.
- `offDetector` is (u, v) and reaches TIGRE as (v, u), positive v towards +z. (NAF's own ray code adds the
  second entry along -z instead; the stored projections come from TIGRE, so TIGRE's sign is followed.)
- `nDetector` and `dDetector` are (v, u) to TIGRE and R2-Gaussian but (u, v) to NAF. The projections' shape
  decides; a square panel is read as (v, u).
- `image` is [x, y, z]; the held-out views are `val`, in some files `test`.

A pickle is a program. Here it may only build dictionaries, lists, tuples, strings, numbers and numeric
arrays. The few NumPy names that it may use are replaced by code of this module, so that not even NumPy's own
functions run. `find_class` of `pickle.Unpickler` alone is not enough: twenty tuples that each hold the one before ten times are
hashed for ever as the key of a dictionary.
"""

from __future__ import annotations

import math
import mmap
import os
import pickle
import pickletools
from os import PathLike
from typing import Any, ClassVar, Literal

import numpy as np

from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import require_room
from lingo_mi.files.arrays import numeric
from lingo_mi.files.scanner_dict import (
    angle_range,
    circular_geometry,
    from_geometry,
    make_dataset,
    make_scan,
    to_geometry,
)
from lingo_mi.scan import Dataset
from lingo_mi.storage.file_access import one_line, reading, replacing

_MOST = 1_000_000  # instructions of a pickle, and values in it; an array is one of a few instructions
_LONGEST_TEXT = 10_000


class _Refused(Exception):
    """The pickle contains something that is not data."""


class _DType:
    """Stands for numpy.dtype: a numeric type and a byte order, nothing else."""

    __slots__ = ('value',)

    value: np.dtype

    def __init__(self, name):
        try:
            value = np.dtype(name) if isinstance(name, str) else None
        except TypeError:
            value = None
        if value is None or value.kind not in 'biufc':
            raise _Refused(f'the array type {name!r}')
        self.value = value

    def __setstate__(self, state):
        if not (
            isinstance(state, tuple)
            and len(state) >= 5
            and state[1] in ('<', '>', '|', '=')
            and all(x is None for x in state[2:5])
        ):
            raise _Refused('an array type with fields')
        if self.value.itemsize > 1:
            self.value = self.value.newbyteorder(state[1])


def _array(shape, dtype, data, order: Literal['C', 'F'] = 'C') -> np.ndarray:
    if not (
        isinstance(dtype, _DType)
        and isinstance(data, (bytes, bytearray))
        and isinstance(shape, tuple)
        and all(isinstance(n, int) and n >= 0 for n in shape)
    ):
        raise _Refused('an array that does not hold plain numbers')
    if math.prod(shape) * dtype.value.itemsize != len(data):
        raise _Refused('an array whose size does not match its shape')
    return np.frombuffer(data, dtype.value).reshape(shape, order=order)


class _Array:
    """Stands for a numpy.ndarray, whose own __setstate__ the pickle must not reach."""

    __slots__ = ('value',)

    def __init__(self, value=None):
        self.value = value

    def __setstate__(self, state):
        if not (isinstance(state, tuple) and len(state) == 5):
            raise _Refused('an array of an unknown version')
        _, shape, dtype, fortran, data = state
        self.value = _array(shape, dtype, data, 'F' if fortran else 'C')


def _encoded(text, encoding):
    """_codecs.encode: how protocol 2 writes bytes."""
    if not isinstance(text, str) or encoding != 'latin1':
        raise _Refused('a text encoding other than latin1')
    return text.encode('latin1')


_NAMES = {
    ('numpy', 'ndarray'): lambda shape, dtype, data: _Array(_array(shape, dtype, data)),
    ('numpy', 'dtype'): lambda name, *_: _DType(name),
    ('_codecs', 'encode'): _encoded,
}
for _core in ('numpy.core', 'numpy._core'):  # NumPy 1, NumPy 2
    _NAMES[f'{_core}.multiarray', '_reconstruct'] = lambda *_: _Array()
    _NAMES[f'{_core}.multiarray', 'scalar'] = lambda dtype, data: _array((), dtype, data)[()]
    _NAMES[f'{_core}.numeric', '_frombuffer'] = lambda data, dtype, shape, order: _Array(
        _array(shape, dtype, data, 'F' if order == 'F' else 'C')
    )

_PythonUnpickler: Any = getattr(pickle, '_Unpickler')  # noqa: B009 - not declared


class _Unpickler(_PythonUnpickler):
    """In Python: it looks at the keys of dictionaries before they are hashed, and at what a state is set of."""

    dispatch: ClassVar[dict] = dict(_PythonUnpickler.dispatch)

    def load_build(self):
        if not isinstance(self.stack[-2], _Array | _DType):
            raise _Refused('a state for something that has none')
        super().load_build()

    dispatch[pickle.BUILD[0]] = load_build

    def find_class(self, module, name):
        try:
            return _NAMES[module, name]
        except KeyError:
            raise _Refused(f'the global {module}.{name}') from None

    def persistent_load(self, pid):
        raise _Refused('a persistent object')


def _with_plain_keys(load, keys):
    def checked(unpickler):
        _plain_keys(unpickler.stack[keys])
        load(unpickler)

    return checked


for _code, _keys in (
    (pickle.SETITEM, slice(-2, -1)),
    (pickle.SETITEMS, slice(0, None, 2)),
    (pickle.DICT, slice(0, None, 2)),
):
    _Unpickler.dispatch[_code[0]] = _with_plain_keys(_Unpickler.dispatch[_code[0]], _keys)


def _plain_keys(keys):
    for key in keys:
        if not isinstance(key, (str, bytes, int, float)):
            raise _Refused(f'a dictionary with a key of type {type(key).__name__}')
        _plain(key)


def _scan(stream):
    """Reads the pickle's instructions without following them. Refuses more than a scan needs, and places in the memo beyond
    their number: the memo is a table up to its last place."""
    for count, (code, argument, _) in enumerate(pickletools.genops(stream)):
        if count > _MOST:
            raise _Refused(f'more than {_MOST} instructions')
        if code.name in ('EMPTY_SET', 'FROZENSET'):
            raise _Refused('a set')
        place: Any = argument
        if 'PUT' in code.name and int(place) > count:
            raise _Refused(f'place {argument} of the memo')


def _resolve(value, left, depth=0):
    """`value` with real arrays in place of their stand-ins. Anything but plain data is refused.

    Parameters
    ----------
    left
        [how many values it may still hold]: one that is used again counts again.
    """
    left[0] -= 1
    if left[0] < 0:
        raise _Refused(f'more than {_MOST} values')
    if depth > 32:
        raise _Refused('data nested more than 32 deep')
    if isinstance(value, _Array):
        return value.value
    if isinstance(value, dict):
        return {key: _resolve(v, left, depth + 1) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_resolve(v, left, depth + 1) for v in value)
    return _plain(value)


def _plain(value):
    if isinstance(value, (str, bytes, bytearray)) and len(value) > _LONGEST_TEXT:
        raise _Refused(f'a text of {len(value)} characters')
    if isinstance(value, int) and value.bit_length() > 1024:
        raise _Refused(f'a whole number of {value.bit_length()} bits')
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, bytearray, np.generic)):
        return value
    if isinstance(value, _DType):
        return value.value
    raise _Refused(f'a value of type {type(value).__name__}')


def load_pickle(path: PathLike | str) -> Any:
    """The plain data in a pickle, protocols 0 to 5 of Python 3, written by NumPy 1 or 2.

    Raises
    ------
    InputError
        If the file is missing, truncated, or holds anything but dictionaries, lists, tuples, strings, numbers and numeric arrays;
        the message names the refused global. No code named by the file is run.
    """
    with reading(path), open(path, 'rb') as stream:
        try:
            if os.path.getsize(path):
                with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
                    _scan(mapped)
            require_room(2 * os.path.getsize(path), path)
            return _resolve(_Unpickler(stream).load(), [_MOST])
        except _Refused as refused:
            raise InputError(
                f'{path}: the pickle asks for {one_line(refused)}, which plain scan data does '
                'not need; do not trust this file, or export it again as arrays and '
                'numbers'
            ) from None
        except (OSError, InputError):
            raise
        except Exception as error:  # a damaged pickle may fail in any way at all
            raise InputError(
                f'{path}: is truncated, damaged or not a pickle ({one_line(error)}); fetch it again'
            ) from None


def _split(data, name, where):
    split = data[name]
    if not isinstance(split, dict) or not {'projections', 'angles'} <= split.keys():
        raise InputError(f"{where}: '{name}' must be a dictionary with 'projections' [n, v, u] and 'angles' [n]")
    arrays = []
    for key, ndim in (('projections', 3), ('angles', 1)):
        label = f"{where}: {name}['{key}']"
        array = _as_array(split[key], label, ndim)
        if array.shape[:1] == (0,):
            raise InputError(f'{label} has no views; give at least one')
        arrays.append(numeric(array, label, ndim))
    projections, angles = arrays
    count = data.get('numTrain' if name == 'train' else 'numVal')
    if count is not None and not isinstance(count, (int, float, np.integer, np.floating)):
        raise InputError(f'{where}: the number of views must be one number, not {shown(count)}')
    if len(angles) != len(projections) or count not in (None, len(angles)):
        raise InputError(
            f"{where}: '{name}' has {len(projections)} projections and {len(angles)} angles, "
            f'and the file announces {"none" if count is None else count}; these must agree'
        )
    return projections, angles


def _as_array(value, label, ndim) -> np.ndarray:
    try:
        # NumPy would turn lists with texts into texts, all as long as the longest.
        return value if isinstance(value, np.ndarray) else np.asarray(value, float)
    except (ValueError, TypeError, OverflowError, MemoryError):
        raise InputError(f'{label} is not an array; store {ndim} dimensions of numbers') from None


def read_naf(path: PathLike | str) -> Dataset:
    """Reads a NAF / SAX-NeRF pickle.

    Required: DSO, DSD (cone beam), nDetector, dDetector or sDetector, nVoxel, dVoxel or sVoxel (mm), and
    train: {projections [n, v, u], angles [n] radians}. Optional: val or test, image [x, y, z], mode ('cone'),
    offOrigin, offDetector (u, v), numTrain, numVal. Other keys are ignored.

    Returns
    -------
    Dataset
        A Dataset with projections in density times mm (the file's, times 1000).

    Raises
    ------
    InputError
        If the file is missing, damaged, refused (see `load_pickle`) or contradicts itself.
    """
    data = load_pickle(path)
    if not isinstance(data, dict) or 'train' not in data:
        raise InputError(f"{path}: is not a NAF scan: a dictionary with the key 'train' is needed")
    scans = {}
    for name in ('train', 'val', 'test'):
        if data.get(name) is None or (name == 'test' and 'val' in scans):
            continue
        projections, angles = _split(data, name, path)
        geometry = to_geometry(data, angles, path, detector_shape=projections.shape[1:], offset_order='uv')
        scans[name] = make_scan(geometry, projections.astype(np.float32) * np.float32(1000), path)
    volume = data.get('image')
    if volume is not None:
        label = f"{path}: 'image'"
        volume = numeric(_as_array(volume, label, 3), label, 3)
    return make_dataset(scans['train'], scans.get('val', scans.get('test')), volume, path)


class _Pickler(pickle.Pickler):
    def reducer_override(self, obj):
        # NumPy 2 would name numpy._core, which NumPy 1 cannot import; these two names are common to both.
        if type(obj) is np.ndarray:
            return np.ndarray, (obj.shape, obj.dtype, bytearray(np.ascontiguousarray(obj).data.cast('B')))
        return NotImplemented


def write_pickle(path: PathLike | str, data: dict[str, Any]) -> None:
    """Writes a dictionary of plain data and arrays that Python reads under NumPy 1 and 2, whole or not at all.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with replacing(path) as temporary, open(temporary, 'wb') as stream:
        _Pickler(stream, protocol=5).dump(data)


def write_naf(path: PathLike | str, dataset: Dataset) -> None:
    """Writes a pickle that NAF, SAX-NeRF and R2-Gaussian read, under NumPy 1 and 2, whole or not at all.

    Projections are stored in metres (ours / 1000), nDetector and dDetector as (v, u), offDetector as (u, v). For a panel that is
    not square, NAF's own code expects nDetector as (u, v); the readers of R2-Gaussian and of this module do not.

    Raises
    ------
    InputError
        If the file cannot be written or the test views have another scanner.
    """
    geometry = circular_geometry(dataset, path)
    start, total = angle_range(geometry.angles)
    data = {
        **from_geometry(geometry, offset_order='uv'),
        'numTrain': len(dataset.train),
        'numVal': 0 if dataset.test is None else len(dataset.test),
        'accuracy': 0.5,
        'filter': None,
        'totalAngle': total,
        'startAngle': start,
        'randomAngle': False,
        'convert': False,
        'rescale_slope': 1.0,
        'rescale_intercept': 0.0,
        'normalize': True,
        'noise': 0,
    }
    for name, scan in (('train', dataset.train), ('val', dataset.test)):
        if scan is not None:
            data[name] = {'projections': scan.projections / np.float32(1000), 'angles': scan.geometry.angles}
    if dataset.volume is not None:
        data['image'] = np.asarray(dataset.volume, np.float32)
    write_pickle(path, data)
