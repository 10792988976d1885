"""Pixels that are not valid are filled for filtered backprojection: nearly as good as if they had been measured."""

from dataclasses import replace

import numpy as np
import pytest

import lingo_mi as lm
from helpers.object_scan import scanned
from lingo_mi.reconstruction.fill import filled


@pytest.fixture(scope='module')
def scan():
    return scanned('foot', 'cone', 60)


def kinds(scan):
    """A dead column, dead pixels, pixels that single views lack, a dark row, and a lost view."""
    column, dead, single, row, view = (np.ones(scan.projections.shape, bool) for _ in range(5))
    rng = np.random.default_rng(0)
    column[:, :, 45] = False
    dead[:, rng.random(dead.shape[1:]) < 0.02] = False
    single[rng.random(single.shape) < 0.02] = False
    row[:, 50] = False
    view[7] = False
    return dict(column=column, dead=dead, single=single, row=row, view=view)


@pytest.mark.parametrize(
    ('kind', 'share'), [('column', 0.1), ('dead', 0.1), ('single', 0.1), ('row', 0.2), ('view', 0.2)]
)
def test_filled_pixels(scan, kind, share):
    """They are right to a tenth of their values, rms, and a whole row or view to a fifth. Measured pixels stay."""
    valid = kinds(scan)[kind]
    with pytest.warns(UserWarning, match='that are not valid were filled'):
        actual = filled(replace(scan, valid=valid))
    assert actual.valid is None
    np.testing.assert_array_equal(actual.projections[valid], scan.projections[valid])
    error = actual.projections - scan.projections
    assert np.std(error[~valid]) < share * np.sqrt(np.square(scan.projections[~valid]).mean())


def test_one_dead_pixel_does_not_stop_fdk(scan):
    """In the rays of the dead pixel, the volume is within two hundredths of the volume of all pixels; the slabs equal the
    volume."""
    valid = np.ones(scan.projections.shape, bool)
    valid[:, 50, 45] = False
    holed = replace(scan, valid=valid)
    with pytest.warns(UserWarning, match=r'^60 pixels \(.* of all\) .*; fill=false refuses'):
        volume = lm.reconstruct(holed, lm.FDK(), progress=False).volume
    whole = lm.reconstruct(scan, lm.FDK(), progress=False).volume
    assert 0 < np.abs(volume - whole).max() < 0.02 * whole.max()
    with pytest.warns(UserWarning, match='were filled'):
        slabs = np.concatenate(list(lm.FDK().slabs(holed, 16)), 2)
    np.testing.assert_allclose(slabs, volume, atol=1e-5 * whole.max())
    with pytest.raises(lm.InputError, match='needs every pixel'):
        lm.reconstruct(holed, lm.FDK(fill=False), progress=False)
    with pytest.raises(lm.InputError, match='fill'):
        lm.FDK(fill='yes')


def test_a_sound_scan_is_left_as_it_is(scan):
    assert filled(scan) is scan
