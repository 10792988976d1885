"""Computations that are traced once and then replayed: a call costs some ten microseconds of Python instead of a millisecond.

Dr.Jit traces a function anew in every call, even if its kernels are cached. `dr.freeze` instead launches the kernels of an
earlier call. It infers launch sizes from input sizes, which fails if sizes agree by chance, and it treats Python numbers as
constants. A `Replay` therefore keeps a separate recording for each combination of sizes and settings.
"""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any

import drjit as dr

MOST = 16  # latest recordings kept per function


class Replay:
    """A function of Dr.Jit arrays (or None) and of settings, which are hashable keyword arguments.

    It may differentiate inside, but is not differentiable from outside. It must not wait for the device. Arrays must not be
    empty. Results are evaluated; exceptions pass through. Everything else it reads (module globals) is frozen; a new variant,
    flag or literal makes a new recording. Not thread-safe.
    `dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False)` traces every call instead.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function, self.recordings = function, OrderedDict()

    def __call__(self, *arrays: Any, **settings: Any) -> Any:
        key = tuple(map(dr.width, arrays)), tuple(settings.items()), dr.thread_count()
        function = self.function
        recording = self.recordings.pop(key, None) or dr.freeze(lambda *arrays: function(*arrays, **settings))
        self.recordings[key] = recording
        if len(self.recordings) > MOST:
            self.recordings.popitem(last=False)
        try:
            with _uncollected():
                return recording(*(None if x is None else dr.detach(x) for x in arrays))
        except RuntimeError as error:  # Dr.Jit wraps the exception raised in a recording
            raise (error.__cause__ or error) from None


@contextmanager
def _uncollected():
    """Suspend garbage collection: destroying a Mitsuba scene, for example, while recording would crash the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
