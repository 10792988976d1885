"""A fit as a page that grows while it runs, served to this machine alone.

The server listens on 127.0.0.1, on a port that the system chooses. It answers only requests that name it so and carry the token
of its address. A state is made when a page asks for it, so that without one it costs next to nothing, and as often as `SHARE`
allows. A page is told what it does not know yet: new entries of the history, and arrays that have changed.
"""

from __future__ import annotations

import hmac
import secrets
import sys
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from lingo_mi.common.errors import brief
from lingo_mi.common.progress import clock
from lingo_mi.fitting.fit import Fit
from lingo_mi.geometry.base import Geometry
from lingo_mi.report import template
from lingo_mi.report.data import ReportData
from lingo_mi.report.packing import Arrays, preview
from lingo_mi.report.payload import colour_maps, history, payload

SHARE = 0.015  # part of the fit's processor time that a page may take; the state at the end is shown in any case
MOST_VOXELS = 128**3  # of a volume in the page
MILLISECONDS = 1000  # between two questions of the page
MOST_ENTRIES = 2000  # of the history
PATIENCE = 10.0  # seconds after which a page that has not asked is gone; a finished fit waits no longer for it


class Live:
    """A watcher (see `watch.Watcher`) that serves a page. `address` is where.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the scan.
    title : str
        Title of the page: any text.
    """

    def __init__(self, geometry: Geometry, title: str = ''):
        self.geometry, self.title = geometry, brief(title or 'fit', 120)
        self._token = secrets.token_urlsafe(24)
        self._lock = threading.Lock()
        self._history: list[dict] = []
        self._thinned = 0  # how often the history was thinned
        self._line, self._number, self._done, self._end_seen = 'The fit begins.', 0, False, threading.Event()
        self._data: ReportData | None = None
        self._waiting: Fit | None = None  # the latest, until it is shown
        self._packed: tuple[int, dict, Arrays] = 0, {}, Arrays()
        self._changed: dict[str, int] = {}  # number of the state that last changed each array
        self._packing = threading.Lock()
        self._truth: tuple[np.ndarray, np.ndarray] | None = None  # as given, and smaller
        self._began, self._spent, self._latest, self._asked = time.process_time(), 0.0, 0.0, -np.inf
        self._server = ThreadingHTTPServer(('127.0.0.1', 0), _handler(self))
        self._server.daemon_threads = True
        self._port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, kwargs=dict(poll_interval=0.2), daemon=True).start()

    @property
    def address(self) -> str:
        """Address of the page, with its token."""
        return f'http://127.0.0.1:{self._port}/?token={self._token}'

    def announce(self) -> None:
        """Say the address on standard error; in a notebook, show the page."""
        if 'ipykernel' in sys.modules:
            from IPython.display import IFrame, display  # pyright: ignore[reportMissingImports]

            display(IFrame(self.address, '100%', 900))
        else:
            print(f'live: {self.address}', file=sys.stderr, flush=True)

    # ---- of the fit ----

    def search(self, iteration: int, held_out: float) -> None:
        """See `watch.Watcher`."""
        error = '' if np.isnan(held_out) else f', error of held-out views {held_out:.4g}'
        with self._lock:
            self._line = f'Search for the step to stop at: step {iteration:,}{error}. The fit begins after it.'

    def step(self, entry: dict, total: int) -> None:
        """See `watch.Watcher`."""
        first = self._history[0] if self._history else dict(iteration=0, seconds=0.0)  # a resumed fit begins later
        steps, seconds = entry['iteration'] - first['iteration'], entry['seconds'] - first['seconds']
        left = seconds * (total - entry['iteration']) / max(1, steps)
        parts = [f'Step {entry["iteration"]:,} of {total:,}', f'loss {entry["loss"]:.4g}']
        parts += [f'{entry["gaussians"]:,} Gaussians'] if entry['gaussians'] else []
        parts.append(f'{clock(left)} left' if entry['iteration'] < total else f'done in {clock(entry["seconds"])}')
        with self._lock:
            self._history += history([entry])
            if len(self._history) > MOST_ENTRIES:  # drop every second entry of the earlier half, except measured ones
                half = self._history[: MOST_ENTRIES // 2]
                thinned = [e for i, e in enumerate(half) if i % 2 or 'psnr_2d' in e or 'psnr_3d' in e]
                self._history[: MOST_ENTRIES // 2] = thinned
                self._thinned += 1
            self._line = ', '.join(parts) + '.'
        self._show_if_due()

    def snapshot(self, fit: Fit) -> None:
        """See `watch.Watcher`. It is shown as soon as a page is there and `SHARE` allows it, unless a later one comes first."""
        self._waiting = fit
        self._show_if_due()

    def _show_if_due(self) -> None:
        if self._waiting is None or not self._watched():
            return
        budget = SHARE * (time.process_time() - self._began)
        if self._number == 0 or self._spent + self._latest <= budget:
            self._show(self._waiting)

    def _watched(self) -> bool:
        return time.perf_counter() - self._asked < PATIENCE

    def _show(self, fit: Fit) -> None:
        began, self._waiting = time.process_time(), None  # processor time counts all threads: Dr.Jit's make the volume
        data = self._contents(fit)
        with self._lock:
            self._data, self._number = data, self._number + 1
            self._latest = time.process_time() - began
            self._spent += self._latest

    def close(self, finished: bool) -> None:
        """See `watch.Watcher`. The server ends once a page that is open has seen the end, or after `PATIENCE`."""
        if finished and self._waiting is not None and self._watched():
            self._show(self._waiting)
        with self._lock:
            self._done = True
            self._line += ' The fit is finished.' if finished else ' The fit was stopped.'
        threading.Thread(target=self._end).start()  # no daemon: a process that ends waits for it

    def _end(self) -> None:
        if self._watched():
            self._end_seen.wait(PATIENCE)
        self._server.shutdown()
        self._server.server_close()

    def _contents(self, fit: Fit) -> ReportData:
        whole = fit.report(self.title, dict(history=[]))
        if whole.volume is None:
            return whole
        volume, blocks = preview(whole.volume, MOST_VOXELS)
        if whole.truth is not None and (self._truth is None or self._truth[0] is not whole.truth):
            self._truth = whole.truth, preview(whole.truth, MOST_VOXELS)[0]
        truth = None if whole.truth is None or self._truth is None else self._truth[1]
        return replace(whole, volume=volume, truth=truth, preview=blocks)

    # ---- of the server's threads ----

    def allowed(self, host: str, token: str) -> bool:
        """Return whether a request has this server's own name and its token."""
        names = {f'127.0.0.1:{self._port}', f'localhost:{self._port}'}
        return host in names and hmac.compare_digest(token.encode(), self._token.encode())

    def page(self) -> str:
        """The page, still without anything to show."""
        content = dict(colours=colour_maps(), history=[], live=dict(milliseconds=MILLISECONDS))
        return template.page(self.title, 'a fit that is running', '', '', content, Arrays(), live=True)

    def state(self, seen: int, place: str) -> dict:
        """Return the data that a page does not have yet.

        Parameters
        ----------
        seen : int
            The number of the state that it has seen last.
        place : str
            How far it has the history, as it was told (`history.place`).
        """
        with self._lock:
            self._asked = time.perf_counter()
            number, thinned = self._number, str(self._thinned)
            cut, _, entries = place.partition('.')
            whole = not (cut == thinned and entries.isdecimal() and len(entries) < 10)
            history_part = dict(
                whole=whole,
                entries=self._history[0 if whole else int(entries) :],
                place=f'{thinned}.{len(self._history)}',
            )
            out: dict[str, Any] = dict(number=number, line=self._line, done=self._done, history=history_part)
        return out if number in (0, seen) else out | self._news(seen)

    def sent(self, state: dict) -> None:
        """A page has this state now."""
        if state['done']:
            self._end_seen.set()

    def spent(self, seconds: float) -> None:
        """Processor time that a question has taken."""
        with self._lock:
            self._spent += seconds

    def _news(self, seen: int) -> dict:
        """The latest state: what the scripts know of it, and the arrays that have changed since state `seen`."""
        with self._packing:
            with self._lock:
                number, data = self._number, self._data
            packed_number, content, arrays = self._packed
            if packed_number != number and data is not None:
                began, before = time.thread_time(), arrays
                content, arrays = payload(data, surfaces=False, earlier=before)
                content['arrays'] = {name: packed.head() for name, packed in arrays.items()}
                self._changed |= {name: number for name, packed in arrays.items() if before.get(name) is not packed}
                self._packed = number, content, arrays
                with self._lock:
                    self._latest += time.thread_time() - began
            page_state = seen if seen <= number else 0
            new = {name: packed.text for name, packed in arrays.items() if self._changed[name] > page_state}
            return dict(number=number, known=content, texts=new)


def _handler(live: Live) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = 10

        def do_GET(self):
            began = time.thread_time()
            self._respond()
            live.spent(time.thread_time() - began)

        def _respond(self):
            address = urlsplit(self.path)
            asked = parse_qs(address.query)
            if not live.allowed(self.headers.get('Host', ''), asked.get('token', [''])[0]):
                return self._answer(
                    403, 'text/plain', 'the address of this page has a token, which is missing or wrong\n'
                )
            if address.path == '/':
                return self._answer(200, 'text/html', live.page())
            if address.path != '/state':
                return self._answer(404, 'text/plain', 'there is nothing here\n')
            seen = asked.get('seen', ['0'])[0]
            number = int(seen) if seen.isdecimal() and len(seen) < 10 else 0
            state = live.state(number, asked.get('history', [''])[0])
            self._answer(200, 'application/json', template.as_json(state))
            live.sent(state)

        def _answer(self, code, kind, text):
            body = text.encode('utf-8', 'backslashreplace')
            try:
                self.send_response(code)
                for name, value in (
                    ('Content-Type', f'{kind}; charset=utf-8'),
                    ('Content-Length', str(len(body))),
                    ('Cache-Control', 'no-store'),
                    ('Referrer-Policy', 'no-referrer'),
                    ('X-Content-Type-Options', 'nosniff'),
                ):
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body)
            except OSError:  # the page has gone
                self.close_connection = True

        def log_message(self, format, *args):
            pass

    return Handler
