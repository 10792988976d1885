"""The live page: who may see it, what it shows of a real fit, and that a fit never depends on it."""

import http.client
import json
import queue
import re
import threading
import time
import warnings
from types import SimpleNamespace
from urllib.parse import urlsplit

import mitsuba as mi
import numpy as np
import pytest

import lingo_mi as lm
from helpers.browser import browser, opened, readout
from lingo_mi.report.data import ReportData
from lingo_mi.results.live import SHARE, Live
from lingo_mi.results.watch import Watch, watched

SMALL = dict(n_points=300, iterations=60)


@pytest.fixture(scope='module')
def data():
    angles = lm.circular(6)
    scan = dict(DSO=100, DSD=150, nDetector=20, dDetector=3, nVoxel=16, dVoxel=2)
    return lm.simulate(
        lm.phantom('foot', size=16).data,
        lm.Geometry.cone(angles=angles, **scan),
        held_out=lm.Geometry.cone(angles=angles + 0.3, **scan),
        progress=False,
    )


@pytest.fixture
def live(data):
    page = Live(data.train.geometry, '<b>title')
    yield page
    page._asked = -np.inf  # nobody is there to see the end
    page.close(True)


def get(live, path, host=None):
    """Status, headers and body that the server answers with."""
    link = http.client.HTTPConnection('127.0.0.1', live._port, timeout=10)
    link.request('GET', path, headers={} if host is None else {'Host': host})
    answer = link.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read().decode()


def token(live):
    return urlsplit(live.address).query


def test_only_who_knows_the_token_may_look(live):
    for path in ('/', '/?token=', '/?token=x', f'/?{token(live)}x', '/state', '/state?seen=0'):
        status, _, text = get(live, path)
        assert status == 403 and len(text) < 100, path
    status, headers, text = get(live, f'/?{token(live)}')
    assert status == 200 and '&lt;b&gt;title' in text and "connect-src 'self'" in text
    assert headers['Cache-Control'] == 'no-store' and headers['Referrer-Policy'] == 'no-referrer'
    assert token(live).removeprefix('token=') not in text
    assert len(token(live)) > 36
    assert get(live, f'/etc/passwd?{token(live)}')[0] == 404


def test_only_by_its_own_name(live):
    """A site whose name is made to point here is refused."""
    for host in ('example.com', f'example.com:{live._port}', '127.0.0.1', ''):
        assert get(live, f'/?{token(live)}', host)[0] == 403, host
    assert get(live, f'/?{token(live)}', f'localhost:{live._port}')[0] == 200


def test_it_listens_on_this_machine_alone(live):
    assert live._server.server_address[0] == '127.0.0.1'


def test_a_damaged_question(live):
    for seen in ('x', '-1', '9' * 50, '%00'):
        status, _, text = get(live, f'/state?{token(live)}&seen={seen}')
        assert status == 200 and json.loads(text)['number'] == 0


def test_two_pages_have_two_tokens(data):
    pages = [Live(data.train.geometry) for _ in range(2)]
    assert len({page.address for page in pages}) == 2 and token(pages[0]) != token(pages[1])
    for page in pages:
        page.close(True)


def fit(data, **options):
    return lm.fit(data, 'fast', progress=False, **SMALL, **options)


def test_a_fit_is_the_same_with_and_without(data, capsys, sums_in_order):
    plain, seen = fit(data), fit(data, live=True)
    assert re.search(r'^live: http://127.0.0.1:\d+/\?token=\S+$', capsys.readouterr().err, re.M)
    for a, b in zip(plain.gaussians, seen.gaussians):
        np.testing.assert_array_equal(a, b)
    keys = 'iteration', 'loss', 'gaussians', 'psnr_2d', 'psnr_3d'
    assert [[e[k] for k in keys] for e in plain.history] == [[e[k] for k in keys] for e in seen.history]


class Failing:
    """A watcher that fails at one of its calls."""

    def __init__(self, at):
        self.at = at

    def search(self, iteration, held_out):
        self._fail('search')

    def step(self, entry, total):
        self._fail('step')

    def snapshot(self, fit):
        self._fail('snapshot')

    def close(self, finished):
        self._fail('close')

    def _fail(self, here):
        if here == self.at:
            raise RuntimeError('no\nviewer')


@pytest.mark.parametrize('at', ['step', 'snapshot', 'close'])
def test_a_watcher_that_fails_is_left_out(data, at, monkeypatch):
    monkeypatch.setattr('lingo_mi.api.fitting.watchers_of', lambda *_: [Failing(at)])
    with pytest.warns(UserWarning, match=r'Failing has failed \(no viewer\); the fit goes on'):
        assert len(fit(data)) > 0


def test_ctrl_c_passes(data):
    """The watchers are closed, too."""
    closed = []

    class Quiet(Failing):
        def close(self, finished):
            closed.append(finished)

    with pytest.raises(KeyboardInterrupt), watched([Quiet('')], 10) as watch:
        watch.step(1, lambda: 0.5, 3)
        raise KeyboardInterrupt
    assert closed == [False]


def test_steps_are_told_once_a_second_and_with_what_was_measured():
    entries = []

    class Told(Failing):
        def step(self, entry, total):
            entries.append(entry)

    watch = Watch([Told('')], 1000)
    for i in range(1, 1001):
        if i == 500:
            watch._new = dict(psnr_2d=30.0)
        watch.step(i, lambda: 0.5, 3)
    assert (
        [e['iteration'] for e in entries] == [500, 1000] and entries[0]['psnr_2d'] == 30 and 'psnr_2d' not in entries[1]
    )


def test_a_fit_that_stops_early(live):
    """The page shows its search, then steps out of those to the stop; `gaussians` is None for a neural field."""
    watch = Watch([live], 1000)
    step = lambda **fields: watch.step(loss=lambda: 0.5, gaussians=None, **fields)  # noqa: E731
    watch._reported = -1.0
    step(iteration=10, held_out=0.25)
    assert asked(live)['line'].startswith('Search for the step to stop at: step 10, error of held-out views 0.25.')
    watch._reported = -1.0
    step(iteration=100, stops_at=400)
    assert asked(live)['line'].startswith('Step 100 of 400, loss 0.5, ')
    step(iteration=400, stops_at=400)
    assert 'Step 400 of 400' in asked(live)['line'] and watch.watchers == [live]


def test_a_lost_viewer_stops_nothing(data, monkeypatch):
    """It breaks off in the middle of an answer, again and again."""
    pages = []
    monkeypatch.setattr(Live, 'announce', lambda page: pages.append(page))

    def break_off():
        while not pages:
            time.sleep(0.01)
        for _ in range(30):
            link = http.client.HTTPConnection('127.0.0.1', pages[0]._port, timeout=5)
            try:
                link.request('GET', f'/state?{token(pages[0])}&seen=0')
                link.sock.recv(1)
            except OSError:  # the fit has ended
                return
            finally:
                link.close()
            time.sleep(0.02)

    thread = threading.Thread(target=break_off, daemon=True)
    thread.start()
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        result = fit(data, live=True)
    thread.join()
    assert len(result) > 0


class Drawn:
    """A fit as a watcher sees it, without steps."""

    def __init__(self, data, shift=0.0):
        self.data, self.shift = data, np.float32(shift)

    def report(self, title, numbers):
        rng, grid, test = np.random.default_rng(0), self.data.train.geometry, self.data.test
        return ReportData(
            title=title,
            metrics=numbers,
            volume=self.data.volume + self.shift,
            truth=self.data.volume,
            shape=grid.grid.shape,
            spacing=grid.grid.spacing,
            centre=grid.grid.centre,
            pixel=grid.dDetector,
            views=test.projections + self.shift,
            views_truth=test.projections,
            views_angles=np.degrees(test.geometry.angles),
            cloud_centres=rng.random((30, 3)),
            cloud_scales=rng.random((30, 3)) + 0.1,
            cloud_quaternions=rng.normal(0, 1, (30, 4)),
            cloud_density=rng.random(30),
        )


def entry(iteration, **more):
    return dict(iteration=iteration, seconds=iteration / 10, loss=1 / iteration, gaussians=30, **more)


def asked(live, seen=0, place=''):
    """Return the answer of the server to the page."""
    status, _, text = get(live, f'/state?{token(live)}&seen={seen}&history={place}')
    assert status == 200
    return json.loads(text, parse_constant=pytest.fail)  # NaN and Infinity are not JSON


def test_a_page_is_told_what_it_does_not_know(live, data):
    """It gets new entries of the history, and the arrays that have changed, so the truth only once."""
    asked(live)
    live.step(entry(1), 100)
    live.snapshot(Drawn(data))
    live.step(entry(2, psnr_2d=float('nan'), psnr_3d=None), 100)
    first = asked(live)
    assert [e['iteration'] for e in first['history']['entries']] == [1, 2] and first['history']['whole']
    assert 'psnr_2d' not in first['history']['entries'][1]
    names = {'volume0', 'volume1', 'views0', 'views1', 'centres', 'densities', 'scales', 'quaternions'}
    assert first['number'] == 1 and set(first['texts']) == set(first['known']['arrays']) == names
    place = first['history']['place']
    again = asked(live, 1, place)
    assert again['history']['entries'] == [] and 'texts' not in again and 'known' not in again
    live.step(entry(3), 100)
    live._show(Drawn(data, -0.001 * data.volume.max()))
    news = asked(live, 1, place)
    assert [e['iteration'] for e in news['history']['entries']] == [3] and not news['history']['whole']
    # The first state's range has no room for values below 0, so that all volumes are packed anew; from then on it has.
    live._show(Drawn(data, -0.0005 * data.volume.max()))
    news = asked(live, 2, news['history']['place'])
    assert set(news['texts']) == {'volume0', 'views0'} and set(news['known']['arrays']) == names
    assert set(asked(live, 1)['texts']) == {'volume0', 'volume1', 'views0', 'views1'}
    assert set(asked(live)['texts']) == set(asked(live, 99)['texts']) == names


def test_a_history_that_is_thinned_is_told_as_a_whole(live, monkeypatch):
    monkeypatch.setattr('lingo_mi.results.live.MOST_ENTRIES', 10)
    for i in range(1, 9):
        live.step(entry(i), 100)
    place = asked(live)['history']['place']
    for i in range(9, 15):
        live.step(entry(i, **(dict(psnr_2d=30.0) if i == 9 else {})), 100)
    history = asked(live, 0, place)['history']
    iterations = [e['iteration'] for e in history['entries']]
    assert history['whole'] and iterations == sorted(set(iterations)) and 9 in iterations and iterations[-1] == 14
    assert len(iterations) <= 10
    for bad in ('x', '1', '1.x', '.', '1.-1', '9.99999999999999', '%00'):
        assert asked(live, 0, bad)['history']['whole'], bad


def test_looking_takes_its_share_and_no_more(live, data, monkeypatch):
    """Nothing is made where nobody looks. The first state comes at once, and later ones within the share, in which the first
    one counts."""
    clock = SimpleNamespace(now=live._began)
    monkeypatch.setattr('lingo_mi.results.live.time.process_time', lambda: clock.now)
    contents = live._contents
    monkeypatch.setattr(live, '_contents', lambda seen: (setattr(clock, 'now', clock.now + 3.0), contents(seen))[1])
    live.snapshot(Drawn(data))
    assert live._number == 0
    asked(live)
    live.step(entry(1), 10_000)  # not a new look: the one before, for the page that has come since
    assert live._number == 1
    for _ in range(1000):
        clock.now += 1.0
        live.snapshot(Drawn(data))
    assert 3.0 * live._number <= SHARE * (clock.now - live._began) < 3.0 * (live._number + 2)


@pytest.fixture(scope='module')
def chromium():
    with browser() as started:
        yield started


def wait_for_quiet(page):
    """Wait until all parts have been made and drawn."""
    page.locator('#main[aria-busy=false]').wait_for()
    page.evaluate('() => new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))')


def test_a_part_that_fails_is_said_once_and_the_page_goes_on(chromium, live, data):
    """The line and the other parts go on, and the state is not asked for again."""
    with opened(chromium, live.address, offline=False, first='IntersectionObserver = undefined') as page:
        for i in (1, 2, 3):
            live.step(entry(i), 3)
            live._show(Drawn(data, i * 0.001))
            page.locator('#live').filter(has_text=f'Step {i} of 3').wait_for()
            while not any(f'seen={i}&' in url for url in page.addresses):  # the next question
                page.wait_for_timeout(100)
        wait_for_quiet(page)
        assert [message.split(':')[0] for message in page.messages] == ['space could not be shown']
        page.messages.clear()
        assert page.locator('#curves .chart').count() == 2
        value = data.volume[tuple(int(n) for n in readout(page)['voxel'].split(', '))] + 0.003
        assert abs(float(readout(page)['Reconstruction']) - value) < 1e-4 * value


def test_a_fit_that_does_not_answer(chromium, data):
    live = Live(data.train.geometry)
    faster = 'const later = setTimeout; setTimeout = (act, wait) => later(act, wait / 20)'
    with opened(chromium, live.address, offline=False, first=faster) as page:
        live.step(entry(1), 3)
        page.locator('#live').filter(has_text='Step 1 of 3').wait_for()
        live._server.shutdown()
        live._server.server_close()
        page.locator('#live').filter(has_text='The fit does not answer any more').wait_for()
        # The second, where Chromium had opened a connection ahead.
        gone = r'Failed to load resource: net::ERR_(CONNECTION_\w+|SOCKET_NOT_CONNECTED)'
        assert all(re.fullmatch(gone, message) for message in page.messages) and len(page.messages) == 5, page.messages
        page.messages.clear()


@pytest.mark.thorough
def test_the_page_follows_a_real_fit(chromium, data, monkeypatch):
    """Its last values come from the fit's volume. Once it has something to show, the fit waits for the page."""
    pages, go_on, results = queue.Queue(), threading.Event(), []
    monkeypatch.setattr(Live, 'announce', lambda page: pages.put(page))
    step = Live.step

    def waiting(page, entry, total):
        step(page, entry, total)
        while (
            page._waiting is not None or page._number
        ) and not go_on.is_set():  # before the first look there is nothing
            page._show_if_due()
            go_on.wait(0.05)

    monkeypatch.setattr(Live, 'step', waiting)
    variant = mi.variant()

    def run():
        mi.set_variant(variant)  # of each thread
        results.append(fit(data, live=True))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    address = pages.get(timeout=60).address
    with opened(chromium, address, offline=False) as page:
        page.locator('#live').filter(has_text='Step ').wait_for()
        page.wait_for_selector('#slices canvas.picture')
        first = page.locator('#live').text_content()
        assert re.match(r'Step \d+ of 60, loss \S+, [\d,]+ Gaussians, .*left\.', first), first
        go_on.set()
        page.locator('#live').filter(has_text='The fit is finished.').wait_for()
        wait_for_quiet(page)
        assert page.locator('#curves').is_visible() and page.locator('#space').is_visible()
        assert all(url.startswith(address.split('?')[0]) for url in page.addresses)
        shown = readout(page)
    thread.join(60)
    volume = results[0].volume()
    value = volume[tuple(int(n) for n in shown['voxel'].split(', '))]
    assert abs(float(shown['Reconstruction']) - value) < 1e-4 * volume.max() and value > 0.01
