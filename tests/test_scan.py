"""Scans and data sets of arrays from other libraries."""

import drjit as dr
import numpy as np
import pytest

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError
from lingo_mi.geometry.base import Geometry
from lingo_mi.scan import Dataset, Scan

GEOMETRY = Geometry.parallel(nDetector=(2, 3), dDetector=1, nVoxel=4, dVoxel=1, angles=[0.0, 1.0])
VALUES = np.arange(12, dtype=np.float32).reshape(2, 2, 3)


class Capsule:
    """An array that speaks DLPack only."""

    def __init__(self, values):
        self.values = values

    def __dlpack__(self, **options):
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


class Elsewhere:
    """An array whose numbers NumPy cannot reach."""

    def __array__(self, *_, **__):
        raise TypeError("can't convert\ndevice type tensor to numpy.")


@pytest.mark.parametrize(
    'kind', [list, Capsule, lambda a: dr.llvm.TensorXf(a), np.float64], ids=['list', 'dlpack', 'drjit', 'double']
)
def test_scans_of_any_array(kind):
    scan = Scan(GEOMETRY, VALUES.tolist() if kind is list else kind(VALUES))
    assert type(scan.projections) is np.ndarray and scan.projections.dtype == np.float32
    np.testing.assert_array_equal(scan.projections, VALUES)


def test_masks_and_volumes():
    valid = VALUES > 3
    scan = Scan(GEOMETRY, Capsule(VALUES), Capsule(valid))
    np.testing.assert_array_equal(scan.projections, np.where(valid, VALUES, 0))
    volume = np.ones((4, 4, 4))
    np.testing.assert_array_equal(Dataset(scan, volume=Capsule(volume)).volume, volume)
    assert Dataset(scan).volume is None


def test_without_a_copy():
    assert np.shares_memory(as_numpy(VALUES, 'these'), VALUES)
    assert np.shares_memory(as_numpy(Capsule(VALUES), 'these', np.float32), VALUES)


@pytest.mark.parametrize(
    'values',
    [
        Elsewhere(),
        [[1, 2], [3]],
        'none',
        VALUES.astype(str),
        VALUES.astype(complex),
        VALUES.astype(object),
        None,
        [[[10**400]]],
    ],
)
def test_what_is_no_array(values):
    with pytest.raises(InputError, match='the projections cannot be read as an array') as caught:
        Scan(GEOMETRY, values)
    assert '\n' not in str(caught.value)
    with pytest.raises(InputError, match='the volume cannot'):
        Dataset(Scan(GEOMETRY, VALUES), volume=Elsewhere())


def test_pixels_that_are_not_finite_say_how_to_leave_them_out():
    values = VALUES.copy()
    values[1, 0, 2] = np.nan
    with pytest.raises(InputError, match='first in view 1.*valid=mask'):
        Scan(GEOMETRY, values)
    assert Scan(GEOMETRY, values, valid=np.isfinite(values)).projections[1, 0, 2] == 0


@pytest.mark.parametrize('index', [[2], [-3], 1, [0.5], 'all', None, [[0, 1]], [[0], [0, 1]], [True], True])
def test_views_that_are_none(index):
    for some in Scan(GEOMETRY, VALUES), GEOMETRY:
        with pytest.raises(InputError, match='views are chosen by'):
            some.subset(index)


@pytest.mark.parametrize('index', [[1, 0], [-1], slice(1, None), np.array([0]), [False, True], (1,)])
def test_views_of_a_scan(index):
    part = Scan(GEOMETRY, VALUES).subset(index)
    chosen = np.arange(2)[index if isinstance(index, slice) else np.asarray(index)]
    np.testing.assert_array_equal(part.projections, VALUES[chosen])
    np.testing.assert_array_equal(part.geometry.angles, GEOMETRY.angles[chosen])
