"""The running mean of the parameters: what it is, where it begins anew, and that resuming keeps it."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from helpers.fits import SHORT, assert_equal_states, geometry, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.fitting import loop
from lingo_mi.fitting.average import Average
from lingo_mi.fitting.models.integral import PARAMETERS
from lingo_mi.fitting.options.rates import DensityRates

AVERAGED = SHORT.changed(average=0.8, iterations=16)


def centres_of(method, scan):
    """The fit, and the centres after every one of its steps."""
    seen = []

    class Spy(Average):
        def add(self, state):
            seen.append(state.host().values)
            super().add(state)

    patch = pytest.MonkeyPatch()
    patch.setattr(loop, 'Average', Spy)
    try:
        return loop.run(scan, method, seed=3), seen
    finally:
        patch.undo()


def test_the_result_is_the_mean_since_the_last_densification():
    """SHORT densifies after iterations 6 and 12: the mean begins with the parameters after the next step."""
    scan = tiny_scan(geometry())
    fitted, seen = centres_of(AVERAGED, scan)
    assert fitted.state.born.any() and len(seen) == 16
    for k in PARAMETERS:
        mean = seen[12][k].astype(float)
        for value in seen[13:]:
            mean = 0.8 * mean + 0.2 * value[k]
        np.testing.assert_allclose(fitted.state.values[k], mean, rtol=1e-5, atol=1e-5)
        assert not np.allclose(mean, seen[-1][k], rtol=1e-4, atol=1e-4)


def test_measurements_are_of_the_mean():
    scan = tiny_scan(geometry())
    measured = []
    fitted = loop.run(scan, AVERAGED, seed=3, measure=lambda fit: measured.append(fit.state) or {})
    assert_equal_states(measured[-1], fitted.state)


@pytest.mark.parametrize('stop', [14, 12, 16])
def test_a_resumed_fit_has_the_same_mean(tmp_path, stop, sums_in_order):
    """It is stopped in between, right after a densification, or after the last step."""
    scan, path = tiny_scan(geometry()), tmp_path / 'fit.npz'
    whole = loop.run(scan, AVERAGED, seed=3)
    with pytest.raises(KeyboardInterrupt):
        loop.run(scan, AVERAGED, seed=3, path=path, progress=stop_at(stop))
    for _ in range(2):  # the second time a fit that is done
        assert_equal_states(loop.run(scan, AVERAGED, seed=3, path=path, resume=True).state, whole.state)


@pytest.mark.parametrize('average', [-0.1, 1.0])
def test_bad_decay(average):
    with pytest.raises(InputError, match='average'):
        DensityRates(average=average)


@pytest.mark.parametrize('decay', [0.0, 0.5])
def test_a_measured_state_stays_as_it_was(decay):
    """A page that is opened later shows the fit of its moment."""
    state, average = SimpleNamespace(values=dict(density=mi.Float([1.0, 2.0]))), Average(decay)
    average.add(state)
    seen = average.of(state)
    before = seen.values['density'].numpy().copy()
    state.values['density'] = state.values['density'] + 1
    average.add(state)
    np.testing.assert_array_equal(seen.values['density'].numpy(), before)
