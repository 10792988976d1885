"""Arrays of files: what may be used as numbers."""

import io

import numpy as np
import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.files.arrays import numeric
from lingo_mi.files.voxels import read_exactly

LARGEST = float(np.finfo(np.float32).max)


@pytest.mark.parametrize(
    'values, says',
    [
        ([1.0, np.nan], 'f: holds NaN or infinity (first at (1,)); mask or repair those values first'),
        ([[1.0], [-np.inf]], 'f: holds NaN or infinity (first at (1, 0)); mask or repair those values first'),
        ([1.0, 1.01 * LARGEST], 'f: holds values beyond 3.4e38, the range of float32; scale them down first'),
        ([1.0, -1.01 * LARGEST], 'f: holds values beyond 3.4e38, the range of float32; scale them down first'),
        ([], 'f: has the shape (0,), but a non-empty array is needed'),
        (['1'], 'f: holds <U1 values; real numbers are needed'),
        ([1j], 'f: holds complex128 values; real numbers are needed'),
    ],
)
def test_refused(values, says):
    with pytest.raises(InputError) as caught:
        numeric(np.array(values), 'f', None)
    assert str(caught.value) == says


@pytest.mark.parametrize('values', [[LARGEST, -LARGEST], np.array([2**63], np.uint64), [True], np.float16([1])])
def test_taken_as_they_are(values):
    values = np.array(values)
    assert numeric(values, 'f', 1) is values


def test_what_need_not_be_finite():
    values = np.array([np.nan, 1e300])
    assert numeric(values, 'f', 1, finite=False) is values


def test_dimensions():
    with pytest.raises(InputError, match=r'has the shape \(2,\), but a non-empty array of 3 dimensions is needed'):
        numeric(np.zeros(2), 'f', 3)


@pytest.mark.parametrize('skip', [0, 1, 2])
def test_bytes_after_others(skip):
    stream = io.BytesIO(b'abcdef')
    stream.seek(skip)
    assert read_exactly(stream, 'f', 3) == b'abcdef'[skip : skip + 3]
    with pytest.raises(InputError, match='end too early'):
        read_exactly(stream, 'f', 4 - skip)
