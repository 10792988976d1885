"""The step to stop at: the search for it, the fit that ends there, resuming either, and what cannot be searched."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.checkpoints import contents, write_as_before
from helpers.fits import SHORT, assert_equal_states, geometry, some_points, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting import checkpoint
from lingo_mi.fitting.bounded import bounded
from lingo_mi.fitting.fitted import Fitted
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.recipes import METHODS
from lingo_mi.fitting.step import Stepper
from lingo_mi.fitting.stopping import Search
from lingo_mi.results.measure import measure, summary

SETTINGS = SHORT.changed(iterations=160, stop='on', stop_every=10, stop_patience=30, average=0.9)


def noisy(photons=200.0, views=12):
    scan = tiny_scan(geometry(views))
    detector = Detector.of(**(Detector.DEFAULTS | dict(photons=photons)))
    light = np.exp(-scan.projections * np.float32(3 / scan.projections.max()))
    counted = np.stack([detector.measure(view, i) for i, view in enumerate(light)])
    return replace(scan, projections=counted, effects=Effects(detector=detector))


@pytest.fixture(scope='module')
def scan():
    return noisy()


@pytest.fixture(scope='module')
def whole(scan):
    return run(scan, SETTINGS, some_points(scan.geometry), seed=3)


def test_it_stops_at_the_step_of_the_least_error(whole):
    errors, steps = whole.search['errors'], whole.search['iterations']
    assert steps == list(range(10, steps[-1] + 1, 10)) and steps[-1] == whole.steps + 30 < 160
    assert errors[steps.index(whole.steps)] == min(errors) < errors[0] / 1.2
    assert whole.history[-1]['iteration'] == whole.steps


def test_its_steps_are_those_of_a_fit_without_a_search(scan, whole, tmp_path, sums_in_order):
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, SETTINGS.changed(stop='off'), some_points(scan.geometry), 3, path=path, progress=stop_at(whole.steps))
    plain = Fitted.from_checkpoint(path)
    for name, values in whole.state.values.items():
        np.testing.assert_array_equal(values, plain.state.values[name])


def fitting(iteration):
    """Interrupts the fit itself, after the search."""

    def progress(done, **fields):
        if 'stops_at' in fields and done == iteration:
            raise KeyboardInterrupt

    return progress


def searched_enough(done, **fields):
    """Interrupts right after the last look: the next step would be the first of the fit."""
    if searched_enough.errors != fields.get('held_out'):
        searched_enough.errors, searched_enough.looks = fields.get('held_out'), searched_enough.looks + 1
    if searched_enough.looks == searched_enough.wanted:
        raise KeyboardInterrupt


@pytest.mark.parametrize('where', ['search', 'between', 'fit'])
def test_resumed_it_is_the_same(scan, whole, tmp_path, where, sums_in_order):
    path = tmp_path / 'fit.npz'
    searched_enough.looks, searched_enough.errors = -1, None  # the first that is shown is no look
    searched_enough.wanted = len(whole.search['errors'])
    progress = dict(search=stop_at(25), between=searched_enough, fit=fitting(20))[where]
    with pytest.raises(KeyboardInterrupt):
        run(scan, SETTINGS, some_points(scan.geometry), seed=3, path=path, progress=progress)
    if where != 'fit':
        with pytest.raises(InputError, match='still searches for the step to stop at'):
            Fitted.from_checkpoint(path)
    again = run(scan, SETTINGS, None, seed=3, path=path)
    assert_equal_states(again.state, whole.state)
    assert again.search == whole.search
    stored = Fitted.from_checkpoint(path)
    assert stored.search == whole.search and stored.steps == whole.steps
    np.testing.assert_array_equal(stored.state.values['centre'], whole.state.values['centre'])


def test_the_search_has_the_rates_of_the_fit(scan):
    """Those of alpha compositing are in units of the radius of the scene, which fewer views tell a little otherwise."""
    given = METHODS['3dgs'].changed(stop='on')
    used = Stepper(scan, bounded(given, scan)).settings.adam.rate_centre
    assert Search(scan, given).stepper().settings.adam.rate_centre == pytest.approx(used, rel=0.1)
    assert used[0] > 2 * given.adam.rate_centre[0]


def test_what_is_told(scan, whole):
    numbers = measure(whole).numbers
    assert numbers['iterations'] == whole.steps and numbers['search']['kept'] == whole.steps
    assert numbers['stopping'] == f'stopped at step {whole.steps}: held-out error did not fall for 30 steps more'
    assert numbers['stopping'] in summary(numbers)
    seen = []
    run(scan, SETTINGS.changed(iterations=10), some_points(scan.geometry), progress=lambda done, **f: seen.append(f))
    assert [('held_out' in f, f.get('stops_at')) for f in seen] == [(True, None)] * 10 + [(False, 10)] * 10


def test_a_search_to_the_end(scan):
    found = run(scan, SETTINGS.changed(iterations=20), some_points(scan.geometry), seed=3)
    assert found.steps == 20 and found.search['said'] == 'took all 20 steps: the held-out error fell to the end'


def test_auto_is_for_scans_whose_noise_is_known(scan):
    auto = SETTINGS.changed(stop='auto')
    assert bounded(auto, scan).stopping.stop == 'on'
    for other, settings in (
        (replace(scan, effects=None), auto),
        (scan.subset([0, 1, 2]), auto),
        (scan, auto.changed(rate_pose=(1e-3, 1e-3))),
    ):
        assert bounded(settings, other).stopping.stop == 'off'
    assert {name for name, s in METHODS.items() if s.stopping.stop != 'off'} <= {'fast'}


@pytest.mark.parametrize(
    'views, changes, message',
    [
        (3, {}, 'needs at least 4 with valid pixels, but the scan has 3'),
        (12, dict(rate_pose=(1e-3, 1e-3)), 'cannot know their poses: take pose_motion=smooth'),
        (12, dict(stop='soon'), "stop is 'off', 'on' or 'auto', not 'soon'"),
        (12, dict(stop_patience=5), 'stop_patience must be at least stop_every, 10, not 5'),
        (12, dict(stop_every=0), 'stop_every must lie in [1, '),
    ],
)
def test_bad_options(views, changes, message):
    with pytest.raises(InputError) as caught:
        bounded(SETTINGS.changed(**changes), noisy(views=views))
    assert message in str(caught.value) and '\n' not in str(caught.value)


def test_views_that_are_held_out_are_not_seen(scan):
    search = Search(scan, SETTINGS)
    assert len(search.seen) == 10 and len(search.held_out) == 2
    seen = {view.tobytes() for view in search.seen.projections}
    assert not any(view.tobytes() in seen for view in search.held_out.projections)
    other = scan.projections.copy()
    other[[2, 7]] += 1  # those held out
    start = search.begin(search.stepper().start(some_points(scan.geometry), np.random.default_rng(0)), 3)[1]
    changed = Search(replace(scan, projections=other), SETTINGS)
    again = changed.begin(changed.stepper().start(some_points(scan.geometry), np.random.default_rng(0)), 3)[1]
    assert_equal_states(start, again)


@pytest.mark.parametrize('where', ['search', 'fit'])
def test_altered_checkpoints(scan, tmp_path, where):
    path = tmp_path / 'fit.npz'
    progress = stop_at(25) if where == 'search' else fitting(20)
    with pytest.raises(KeyboardInterrupt):
        run(scan, SETTINGS, some_points(scan.geometry), seed=3, path=path, progress=progress)
    content = contents(path)
    names = [name for name in content if name.startswith('array.search.')]
    assert len(names) == (4 if where == 'fit' else 8)
    write_as_before(tmp_path / 'old.npz', content | {'array.search.rows': np.ones(7)})  # of earlier programs
    checkpoint.load(tmp_path / 'old.npz')
    for name in names:
        old = content[name]
        gone = [] if name == 'array.search.views' else [None]  # which checkpoints of earlier programs lack
        for bad in (*gone, old[:0], old[..., None], old.astype(complex), old - 1000 if old.ndim == 1 else old[:-1]):
            altered = {k: v for k, v in content.items() if k != name} | ({} if bad is None else {name: bad})
            write_as_before(tmp_path / 'old.npz', altered)
            with pytest.raises(InputError, match='not a checkpoint of a fit, or it is damaged'):
                checkpoint.load(tmp_path / 'old.npz')


def test_views_without_a_valid_pixel_do_not_count(scan, tmp_path):
    """They are no views to hold out, and a search that sees fewer goes on from its checkpoint."""
    valid = np.ones(scan.projections.shape, bool)
    valid[3] = False
    path, settings = tmp_path / 'fit.npz', SETTINGS.changed(fit_air='view')
    with pytest.raises(KeyboardInterrupt):
        run(replace(scan, valid=valid), settings, some_points(scan.geometry), path=path, progress=stop_at(15))
    assert run(replace(scan, valid=valid), settings, None, path=path).search is not None
    valid[3:] = False
    few = replace(scan, valid=valid)
    assert bounded(SETTINGS.changed(stop='auto'), few).stopping.stop == 'off'
    with pytest.raises(InputError, match='at least 4 with valid pixels, but the scan has 3'):
        bounded(SETTINGS, few)
