"""The progress bar: plain where nobody watches, a bar on a terminal, and never in the loop's way."""

import io
import time

import pytest

from lingo_mi.common import progress
from lingo_mi.common.progress import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def ticking(monkeypatch, seconds):
    """Let the clock advance by so many seconds each time it is read."""
    now = [0.0]

    def tick():
        now[0] += seconds
        return now[0]

    monkeypatch.setattr(progress.time, 'monotonic', tick)


def test_a_quick_loop_is_one_line(capsys, monkeypatch):
    ticking(monkeypatch, 1e-4)
    with Progress('Scan', 1000) as p:
        for i in range(1000):
            p.update(i + 1)
    assert capsys.readouterr().err == 'Scan: 1000/1000 (100%), 0:00 elapsed\n'


def test_nothing_is_drawn_where_it_is_not_wanted(capsys):
    with Progress('Scan', 10, shown=False) as p:
        for i in range(10):
            p.update(i + 1)
    assert capsys.readouterr().err == ''


def test_plain_lines_about_every_tenth(capsys, monkeypatch):
    ticking(monkeypatch, 0.02)
    with Progress('Fit', 1000) as p:
        for i in range(1000):
            p.update(i + 1, loss=0.01234567, psnr_2d=31.234, gaussians=51234, note='warm')
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == '' and len(lines) == 10
    assert lines[0].startswith('Fit: 100/1000 (10%), loss 0.01235, PSNR 31.23 dB, 51,234 Gaussians, note warm, 0:02')
    assert 'left' in lines[0] and 'left' not in lines[-1]
    assert lines[-1].startswith('Fit: 1000/1000 (100%)')
    assert ''.join(lines).isprintable()


def test_plain_line_after_ten_seconds(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, 'monotonic', lambda: now[0])
    with Progress('Fit', 1_000_000) as p:
        for i in range(25):
            now[0] += 1
            p.update(i + 1)
    lines = capsys.readouterr().err.splitlines()
    # The last line says where an interrupted loop ended.
    assert [x.split()[1] for x in lines] == ['10/1000000', '20/1000000', '25/1000000']
    assert lines[0].endswith('0:10 elapsed, 277:46:30 left')


def test_resumed_loop_counts_its_own_pace(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, 'monotonic', lambda: now[0])
    with Progress('Fit', 1000, start=800) as p:
        now[0] = 10.0
        p.update(900)
    assert capsys.readouterr().err == 'Fit: 900/1000 (90%), 0:10 elapsed, 0:10 left\n'


def test_the_time_left_goes_by_the_steps_after_the_first(capsys, monkeypatch):
    """The first step may compile kernels, and resumed work may begin far from the start."""
    now = [0.0]
    monkeypatch.setattr(progress.time, 'monotonic', lambda: now[0])
    with Progress('SART', 1000) as p:
        for done, seconds in ((601, 30.0), (700, 129.0)):
            now[0] = seconds
            p.update(done)
    assert capsys.readouterr().err.splitlines()[-1] == 'SART: 700/1000 (70%), 2:09 elapsed, 5:00 left'


def test_values_are_read_only_when_drawn(capsys, monkeypatch):
    ticking(monkeypatch, 0.02)
    calls = []
    with Progress('Fit', 1000) as p:
        for i in range(1000):
            p.update(i + 1, loss=lambda: calls.append(1) or 0.5, psnr_3d=None)
    err = capsys.readouterr().err
    assert len(calls) == 10 and 'loss 0.5' in err and 'None' not in err


@pytest.mark.parametrize('terminal', [False, True])
def test_update_is_cheap(monkeypatch, terminal):
    monkeypatch.setattr('sys.stderr', Terminal() if terminal else io.StringIO())
    monkeypatch.setenv('TERM', 'xterm')
    with Progress('Fit', 10**9) as p:
        start = time.perf_counter()
        for i in range(20_000):
            p.update(i + 1, loss=0.5)
        assert (time.perf_counter() - start) / 20_000 < 1e-4


def test_bar_on_a_terminal(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr('sys.stderr', stream)
    monkeypatch.setenv('TERM', 'xterm')
    monkeypatch.setenv('COLUMNS', '110')
    with Progress('Fit', 3000) as p:
        p.update(3000, loss=0.0123, gaussians=51234)
    text = stream.getvalue()
    assert '\x1b[' in text and 'Fit' in text and '3000/3000' in text and 'loss 0.0123' in text
    assert '51,234 Gaussians' in text


def test_dumb_terminal_gets_plain_lines(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr('sys.stderr', stream)
    monkeypatch.setenv('TERM', 'dumb')
    with Progress('Fit', 2) as p:
        p.update(1)
    assert stream.getvalue().startswith('Fit: 1/2 (50%)') and '\x1b' not in stream.getvalue()


def test_an_error_in_the_loop_passes_through(capsys):
    with pytest.raises(ZeroDivisionError), Progress('Fit', 100) as p:
        p.update(3)
        raise ZeroDivisionError
    assert capsys.readouterr().err.startswith('Fit: 3/100 (3%)')
