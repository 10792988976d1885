"""The step to stop at: the search for it, the fit that ends there, resuming either, and what cannot be searched."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.checkpoints import contents, rewrite
from helpers.fits import SHORT, assert_equal_states, geometry, stop_at, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.effects.detector import Detector
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting import loop
from lingo_mi.fitting.checkpoint import Checkpoint
from lingo_mi.fitting.fit import Fit
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measure import fit_metrics, summary
from lingo_mi.fitting.methods.by_name import METHODS
from lingo_mi.fitting.stopping import HeldOut, sentence

METHOD = SHORT.changed(
    start='fdk', n_points=2000, iterations=160, stop='on', stop_every=10, stop_patience=30, average=0.9
)


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
    return run(scan, METHOD, seed=3)


@pytest.mark.thorough
def test_it_stops_at_the_step_of_the_least_error(whole):
    errors, steps = whole.search['errors'], whole.search['iterations']
    assert steps == list(range(10, steps[-1] + 1, 10)) and steps[-1] == whole.steps + 30 < 160
    assert errors[steps.index(whole.steps)] == min(errors) < errors[0] / 1.2
    assert whole.history[-1]['iteration'] == whole.steps


def test_its_steps_are_those_of_a_fit_without_a_search(scan, whole, tmp_path, sums_in_order):
    path = tmp_path / 'fit.npz'
    with pytest.raises(KeyboardInterrupt):
        run(scan, METHOD.changed(stop='off'), 3, path=path, progress=stop_at(whole.steps))
    plain = Fit.load(path)
    for name, values in whole.state.values.items():
        np.testing.assert_array_equal(values, plain.state.values[name])


def fitting(iteration):
    """A function of progress that interrupts the fit itself, after the search."""

    def progress(done, **fields):
        if 'stops_at' in fields and done == iteration:
            raise KeyboardInterrupt

    return progress


def searched_enough(done, **fields):
    """Interrupt right after the last look, when the next step would be the first of the fit."""
    if searched_enough.errors != fields.get('held_out'):
        searched_enough.errors, searched_enough.looks = fields.get('held_out'), searched_enough.looks + 1
    if searched_enough.looks == searched_enough.wanted:
        raise KeyboardInterrupt


@pytest.mark.parametrize('where', ['search', 'between', pytest.param('fit', marks=pytest.mark.thorough)])
def test_resumed_it_is_the_same(scan, whole, tmp_path, where, sums_in_order):
    path = tmp_path / 'fit.npz'
    searched_enough.looks, searched_enough.errors = -1, None  # the first view shown is not a look
    searched_enough.wanted = len(whole.search['errors'])
    progress = dict(search=stop_at(25), between=searched_enough, fit=fitting(20))[where]
    with pytest.raises(KeyboardInterrupt):
        run(scan, METHOD, seed=3, path=path, progress=progress)
    if where != 'fit':
        with pytest.raises(InputError, match='still searches for the step to stop at'):
            Fit.load(path)
    again = run(scan, METHOD, seed=3, path=path, resume=True)
    assert_equal_states(again.state, whole.state)
    assert again.search == whole.search
    stored = Fit.load(path)
    assert stored.search == whole.search and stored.steps == whole.steps
    np.testing.assert_array_equal(stored.state.values['centre'], whole.state.values['centre'])


def test_the_search_has_the_rates_of_the_fit(scan, monkeypatch):
    """Rates of alpha compositing are in units of the scene's radius, which is slightly different for fewer views."""
    splatting, searched = METHODS['3dgs'].changed(stop='on'), []

    def running(scan, seen, method, seed, stored, search, search_method, cluster):
        searched.append(search_method.stepper(seen).method)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, 'Running', running)
    with pytest.raises(KeyboardInterrupt):
        run(scan, splatting)
    used = splatting.bounded(scan).stepper(scan).method.rates.rate_centre
    assert searched[0].rates.rate_centre == pytest.approx(used, rel=0.1)
    assert used[0] > 2 * splatting.rates.rate_centre[0]


def test_what_is_told(scan, whole):
    numbers = fit_metrics(whole)
    assert numbers['iterations'] == whole.steps and numbers['search']['best'] == whole.steps
    assert numbers['stopping'] == f'stopped at step {whole.steps}: held-out error did not fall for 30 more steps'
    assert numbers['stopping'] in summary(numbers)
    seen = []
    run(scan, METHOD.changed(iterations=10), progress=lambda done, **f: seen.append(f))
    assert [('held_out' in f, f.get('stops_at')) for f in seen] == [(True, None)] * 10 + [(False, 10)] * 10


def test_a_search_to_the_end(scan):
    fitted = run(scan, METHOD.changed(iterations=20), seed=3)
    assert fitted.steps == 20 and sentence(fitted.search) == 'took all 20 steps: the held-out error fell to the end'


def test_auto_is_for_scans_whose_noise_is_known(scan):
    auto = METHOD.changed(stop='auto')
    assert auto.bounded(scan).stopping.stop == 'on'
    for other, method in (
        (replace(scan, effects=None), auto),
        (scan.subset([0, 1, 2]), auto),
        (scan, auto.changed(rate_pose=(1e-3, 1e-3))),
    ):
        assert method.bounded(other).stopping.stop == 'off'
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
        METHOD.changed(**changes).bounded(noisy(views=views))
    assert message in str(caught.value) and '\n' not in str(caught.value)


def test_views_that_are_held_out_are_not_seen(scan, tmp_path, sums_in_order):
    """Neither the start nor the steps see them: whatever they show, the search reaches the same state."""
    held_out = HeldOut(scan, METHOD)
    assert len(held_out.seen) == 10 and len(held_out.views) == 2
    seen = {view.tobytes() for view in held_out.seen.projections}
    assert not any(view.tobytes() in seen for view in held_out.views.projections)
    other = scan.projections.copy()
    other[[2, 7]] += 1  # those held out
    path, states = tmp_path / 'fit.npz', []
    for each in (scan, replace(scan, projections=other)):
        with pytest.raises(KeyboardInterrupt):
            run(each, METHOD.changed(start='edges', n_points=60), seed=3, path=path, progress=stop_at(8))
        stored = Checkpoint.load(path)
        assert stored.searching and stored.seen == 10
        states.append(stored.state)
    assert_equal_states(*states)


@pytest.mark.parametrize('where', ['search', 'fit'])
def test_altered_checkpoints(scan, tmp_path, where):
    path = tmp_path / 'fit.npz'
    progress = stop_at(25) if where == 'search' else fitting(20)
    with pytest.raises(KeyboardInterrupt):
        run(scan, METHOD, seed=3, path=path, progress=progress)
    content = contents(path)
    extra = json.loads(str(content['extra']))
    search, steps, errors = extra['search'], extra['search']['iterations'], extra['search']['errors']
    assert extra['seen'] == (10 if where == 'search' else 12) and len(steps) == len(errors) > 1
    rewrite(path, content, extra)
    Checkpoint.load(path)
    bad = [
        dict(search=None),
        dict(search={k: v for k, v in search.items() if k != 'best'}),
        *(dict(search=search | change) for change in (
            dict(best=None),
            dict(best=-10),
            dict(best=steps[-1] + 10),
            dict(best=steps[0] + 1),
            dict(iterations=steps[::-1]),
            dict(iterations=steps[:-1]),
            dict(iterations=[0, *steps[1:]]),
            dict(iterations=[*steps[:-1], 170]),
            dict(iterations=[str(step) for step in steps]),
            dict(iterations=None),
            dict(errors=errors[:-1]),
            dict(errors=[-error for error in errors]),
            dict(errors=[float('nan'), *errors[1:]]),
            dict(errors=None),
            dict(more=1),
        )),
        dict(seen=0),
        dict(seen=13),
        dict(seen=None),
        dict(seen=12 if where == 'search' else 5),
        dict(settings=extra['settings'] | dict(stop='off')),
        {'iteration': 15 if where == 'search' else search['best'] + 1},
    ]  # fmt: skip
    for change in bad:
        rewrite(path, content, extra | change)
        with pytest.raises(InputError, match='not a checkpoint of a fit, or it is damaged') as caught:
            Checkpoint.load(path)
        assert '\n' not in str(caught.value), change


def test_views_without_a_valid_pixel_do_not_count(scan, tmp_path):
    """They are not held out, and a search that sees fewer views goes on from its checkpoint."""
    valid = np.ones(scan.projections.shape, bool)
    valid[3] = False
    path, method = tmp_path / 'fit.npz', METHOD.changed(start='points', fit_air='view')
    with pytest.raises(KeyboardInterrupt):
        run(replace(scan, valid=valid), method, path=path, progress=stop_at(15))
    assert run(replace(scan, valid=valid), method, path=path, resume=True).search is not None
    valid[3:] = False
    few = replace(scan, valid=valid)
    assert METHOD.changed(stop='auto').bounded(few).stopping.stop == 'off'
    with pytest.raises(InputError, match='at least 4 with valid pixels, but the scan has 3'):
        METHOD.bounded(few)
