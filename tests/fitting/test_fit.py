"""Fits that are read from their checkpoints, without the scan."""

import json

import numpy as np
import pytest

from helpers.checkpoints import contents, rewrite
from helpers.fits import SHORT, assert_equal_states, stop_at
from lingo_mi.common.errors import InputError
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.geometry.grid import Grid


@pytest.mark.parametrize('changes', [{}, dict(average=0.8), dict(rate_pose=(2e-3, 2e-4), effects='ignore')])
def test_a_checkpoint_is_the_fit(scan, tmp_path, changes):
    path = tmp_path / 'fit.npz'
    done = run(scan, SHORT.changed(iterations=8, **changes), seed=3, path=path)
    again = Fit.load(path)
    assert_equal_states(again.state, done.state)
    assert (again.method, again.model.unit, again.history) == (done.method, done.model.unit, done.history)
    assert again.checkpoint.seed == 3
    np.testing.assert_array_equal(again.checkpoint.arrays['initial'], done.checkpoint.arrays['initial'])
    np.testing.assert_allclose(again.volume(), done.volume(), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(again.render(scan.geometry), done.render(scan.geometry), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(again.geometry.rays().source, done.geometry.rays().source, atol=1e-9)
    assert (again.geometry is again.nominal_geometry) == ('rate_pose' not in changes)
    np.testing.assert_allclose(again.cloud().density.numpy(), done.cloud().density.numpy(), rtol=1e-6)
    coarser = Grid((16, 16, 16), (16.0, 16.0, 16.0), scan.geometry.grid.centre)
    assert again.volume(coarser).shape == (16, 16, 16)


def test_an_unfinished_fit_is_its_mean_so_far(scan, tmp_path):
    path = tmp_path / 'fit.npz'
    method, measured = SHORT.changed(average=0.8, densify_from=100), []
    with pytest.raises(KeyboardInterrupt):
        run(scan, method, measure=lambda fit: measured.append(fit.state) or {}, progress=stop_at(8), path=path, at=[8])
    for name, values in Fit.load(path).state.values.items():
        np.testing.assert_array_equal(values, measured[-1].values[name])


def test_files_that_are_no_fit(scan, stored):
    with pytest.raises(InputError, match='there is no fit here'):
        Fit.load(stored.with_name('none.npz'))
    content = contents(stored)
    extra = json.loads(str(content['extra']))
    for damaged, message in (
        (extra | dict(effects=True), 'modelled effects'),
        ({k: v for k, v in extra.items() if k != 'unit'}, 'unit is missing'),
        (extra | dict(settings=extra['settings'] | dict(renamed=1)), "unknown setting 'renamed'"),
        (extra | dict(method='sgd'), "there is no method 'sgd'"),
        (extra | dict(method='naf'), 'unknown setting'),
    ):
        rewrite(stored, content, damaged)
        with pytest.raises(InputError, match=message) as caught:
            Fit.load(stored)
        assert '\n' not in str(caught.value)
