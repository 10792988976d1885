"""Ctrl-C: between the steps of a long loop, never within one; and out of libraries that make another error of it."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back: yields a function that raises KeyboardInterrupt if it was pressed since the last call.

    A loop that calls it between its steps is never stopped within a step, when its state is half old and half new. A
    second Ctrl-C stops at once.
    """
    if threading.current_thread() is not threading.main_thread():  # Python delivers signals to the main thread only
        yield lambda: None
        return
    pressed = []

    def press(*_):
        if pressed:
            raise KeyboardInterrupt
        pressed.append(True)
        print('\nstopping after this step; Ctrl-C again to stop at once', file=sys.stderr)

    def check():
        if pressed:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, press)
    try:
        yield check
        check()  # pressed after the last step
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def noticed() -> Iterator[None]:
    """Raises KeyboardInterrupt if Ctrl-C was pressed within the block, whatever a library has made of it there.

    Mitsuba turns an exception of a plugin into a RuntimeError of its own, whose text depends on where it was raised.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    pressed = []

    def press(number, frame):
        pressed.append(True)
        before(number, frame)

    signal.signal(signal.SIGINT, press)
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException:
        if pressed:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt
