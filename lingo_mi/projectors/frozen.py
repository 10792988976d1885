"""Computations that are traced once and then replayed: a call costs some ten microseconds of Python instead of a millisecond.

Dr.Jit traces a function anew in every call, even where its kernels are in the cache; `dr.freeze` launches the kernels of an
earlier call instead. It infers how large a launch is from the sizes of the inputs, which goes wrong where sizes agree by chance,
and it takes numbers of Python's for constants. A `Replay` therefore keeps a recording of its own for each combination of sizes
and settings.
"""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any

import drjit as dr

MOST = 16  # recordings of a function, the latest ones


class Replay:
    """A function of Dr.Jit arrays, or None in their place, and of settings, which are hashable keyword arguments.

    It may differentiate within, but no derivatives pass through it, and it must not wait for the device. No array may be empty.
    What it returns is evaluated; what it raises, the caller gets. Whatever else it reads, names of its module for one, is a
    constant to the recordings, of which new variants, flags and literals make new ones. It is not for several threads at once.
    `dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False)` has it traced in every call.
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
        except RuntimeError as error:  # Dr.Jit's, around what was raised in a recording
            raise (error.__cause__ or error) from None


@contextmanager
def _uncollected():
    """No garbage is collected: a Mitsuba scene's end, for one, cannot be recorded and would kill the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
