"""The live page: who may see it, what it shows of a real fit, and that a fit never depends on it."""

import http.client
import json
import re
import threading
import time
import warnings
from urllib.parse import urlsplit

import numpy as np
import pytest

import lingo_mi as lm
from helpers.browser import browser, opened, readout
from helpers.script import fit_process
from lingo_mi.results.live import Live
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


def test_a_fit_is_the_same_with_and_without(data, capsys):
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

    def step(self, entry, total):
        self._fail('step')

    def look(self, snapshot):
        self._fail('look')

    def close(self, finished):
        self._fail('close')

    def _fail(self, here):
        if here == self.at:
            raise RuntimeError('no\nviewer')


@pytest.mark.parametrize('at', ['step', 'look', 'close'])
def test_a_watcher_that_fails_is_left_out(data, at, monkeypatch):
    monkeypatch.setattr('lingo_mi.api.fitting.watchers_of', lambda *_: [Failing(at)])
    with pytest.warns(UserWarning, match=r'Failing has failed \(no viewer\); the fit goes on'):
        assert len(fit(data)) > 0


def test_ctrl_c_passes(data):
    """And the watchers are closed."""
    closed = []

    class Quiet(Failing):
        def close(self, finished):
            closed.append(finished)

    with pytest.raises(KeyboardInterrupt), watched([Quiet('')], 10) as watch:
        watch.step(1, lambda: 0.5, 3)
        raise KeyboardInterrupt
    assert closed == [False]


def test_steps_are_told_once_a_second_and_with_what_was_measured():
    told = []

    class Told(Failing):
        def step(self, entry, total):
            told.append(entry)

    watch = Watch([Told('')], 1000)
    for i in range(1, 1001):
        if i == 500:
            watch._new = dict(psnr_2d=30.0)
        watch.step(i, lambda: 0.5, 3)
    assert [e['iteration'] for e in told] == [500, 1000] and told[0]['psnr_2d'] == 30 and 'psnr_2d' not in told[1]


def test_a_lost_viewer_stops_nothing(data, monkeypatch):
    """One that breaks off in the middle of an answer, again and again."""
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


@pytest.mark.slow  # a browser beside a fit: the page's steps have tests of their own
def test_the_page_follows_a_real_fit(scene, tmp_path):
    """Its last values are those of the volume that the fit writes."""
    with browser() as chromium:
        process = fit_process(scene, '--iterations', 12_000, '-D', 'n_points=100', '--live', '--out', tmp_path / 'a')
        address = None
        for line in process.stderr:
            if line.startswith('live: '):
                address = line.split()[1]
                break
        rest = threading.Thread(target=process.stderr.read, daemon=True)
        rest.start()
        with opened(chromium, address, offline=False) as page:
            page.locator('#live').filter(has_text='Step ').wait_for()
            page.wait_for_selector('#slices canvas.picture')
            first = page.locator('#live').text_content()
            assert re.match(r'Step [\d,]+ of 12,000, loss \S+, [\d,]+ Gaussians, .*left\.', first), first
            page.locator('#live').filter(has_text='The fit is finished.').wait_for(timeout=300_000)
            page.locator('#curves').wait_for()
            page.evaluate('() => new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))')
            assert all(url.startswith(address.split('?')[0]) for url in page.asked)
            found = readout(page)
        assert process.wait(timeout=120) == 0
        rest.join()
    volume = lm.load_result(tmp_path / 'a').volume()
    value = volume[tuple(int(n) for n in found['voxel'].split(', '))]
    assert abs(float(found['Reconstruction']) - value) < 1e-4 * volume.max() and value > 0.01
